//! Chromium without a window, driven by its DevTools protocol over a pipe: messages are JSON, each ended by a zero byte.

use serde_json::{Value, json};
use std::error::Error;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

pub(crate) type Outcome<T = ()> = Result<T, Box<dyn Error>>;

/// A page takes no longer than this to be ready.
const PATIENCE: Duration = Duration::from_secs(120);

/// The program, if it is installed: what `LIMPID_CHROMIUM` names, or `chromium` where programs are found.
pub(crate) fn chromium() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os("LIMPID_CHROMIUM") {
        return Some(named.into());
    }
    let folders = std::env::var_os("PATH")?;
    std::env::split_paths(&folders)
        .map(|folder| folder.join("chromium"))
        .find(|path| path.is_file())
}

/// A browser with one page.
pub(crate) struct Browser {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    session: Option<String>,
    last: u64,
    /// What happened in the page: method and parameters.
    pub(crate) events: Vec<(String, Value)>,
    _profile: tempfile::TempDir,
}

impl Browser {
    /// Opens an address in a window of this size, and waits until the page is whole.
    pub(crate) fn open(program: &Path, address: &str, size: [usize; 2]) -> Outcome<Self> {
        let profile = tempfile::tempdir()?;
        // The pipe is file 3 and 4 of the browser: a shell puts them there.
        let mut child = Command::new("sh")
            .args([
                "-c",
                r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null 2>&1"#,
            ])
            .arg(program)
            .args([
                "--headless=new",
                "--no-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-dev-shm-usage",
                "--no-first-run",
                "--remote-debugging-pipe",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg("about:blank")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let to = child.stdin.take().ok_or("piped")?;
        let from = BufReader::new(child.stdout.take().ok_or("piped")?);
        let mut browser = Self {
            child,
            to,
            from,
            session: None,
            last: 0,
            events: Vec::new(),
            _profile: profile,
        };
        browser.show(address, size)?;
        Ok(browser)
    }

    fn show(&mut self, address: &str, [width, height]: [usize; 2]) -> Outcome {
        let targets = self.send("Target.getTargets", json!({}))?;
        let targets = targets["targetInfos"].as_array().ok_or("a list")?;
        let page = targets
            .iter()
            .find(|target| target["type"] == "page")
            .ok_or("a page")?;
        let target = json!({ "targetId": page["targetId"], "flatten": true });
        let attached = self.send("Target.attachToTarget", target)?;
        self.session = attached["sessionId"].as_str().map(str::to_owned);
        for domain in ["Page", "Runtime", "Network", "Log"] {
            self.send(&format!("{domain}.enable"), json!({}))?;
        }
        let size =
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        self.send("Emulation.setDeviceMetricsOverride", size)?;
        self.send("Page.navigate", json!({ "url": address }))?;
        // The scripts have run by then; a report goes on from there.
        self.wait_for("location.href !== 'about:blank' && document.readyState === 'complete'")?;
        self.evaluate("typeof report === 'object' ? report.ready.then(() => true) : true")?;
        Ok(())
    }

    /// Sends a command, and waits for what it gives back.
    fn send(&mut self, method: &str, params: Value) -> Outcome<Value> {
        self.last += 1;
        let mut message = json!({ "id": self.last, "method": method, "params": params });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        let mut bytes = serde_json::to_vec(&message)?;
        bytes.push(0);
        self.to.write_all(&bytes)?;
        loop {
            let mut bytes = Vec::new();
            self.from.read_until(0, &mut bytes)?;
            if bytes.pop() != Some(0) {
                return Err("the browser ended".into());
            }
            let mut reply: Value = serde_json::from_slice(&bytes)?;
            if reply["id"] == self.last {
                return match reply.get("error") {
                    Some(error) => Err(format!("{method}: {error}").into()),
                    None => Ok(reply["result"].take()),
                };
            }
            if let Some(method) = reply["method"].as_str() {
                self.events
                    .push((method.to_owned(), reply["params"].clone()));
            }
        }
    }

    /// What an expression gives in the page; a promise is waited for.
    pub(crate) fn evaluate(&mut self, expression: &str) -> Outcome<Value> {
        let asked =
            json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let mut reply = self.send("Runtime.evaluate", asked)?;
        if let Some(exception) = reply.get("exceptionDetails") {
            return Err(format!("{expression}: {exception}").into());
        }
        Ok(reply["result"]["value"].take())
    }

    /// Waits until an expression of the page holds; an error if that takes too long. While another page comes it may be none.
    pub(crate) fn wait_for(&mut self, condition: &str) -> Outcome {
        let started = Instant::now();
        loop {
            let found = self.evaluate(condition);
            if matches!(found, Ok(Value::Bool(true))) {
                return Ok(());
            }
            if started.elapsed() > PATIENCE {
                return Err(format!("{condition}: never, but {found:?}").into());
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// A PNG of what the window shows.
    pub(crate) fn screenshot(&mut self) -> Outcome<Vec<u8>> {
        use base64::Engine as _;
        let shot = self.send("Page.captureScreenshot", json!({}))?;
        let data = shot["data"].as_str().ok_or("a picture")?;
        Ok(base64::engine::general_purpose::STANDARD.decode(data)?)
    }

    /// What went wrong in the page: exceptions, and all that the console shows.
    pub(crate) fn problems(&self) -> Vec<&Value> {
        let loud = [
            "Runtime.exceptionThrown",
            "Runtime.consoleAPICalled",
            "Log.entryAdded",
        ];
        let events = self.events.iter();
        events
            .filter(|(method, _)| loud.contains(&method.as_str()))
            .map(|(_, params)| params)
            .collect()
    }

    /// The addresses that the page asked for, without what lies in itself.
    pub(crate) fn requests(&self) -> Vec<&str> {
        let sent = self
            .events
            .iter()
            .filter(|(method, _)| method == "Network.requestWillBeSent");
        let addresses = sent.filter_map(|(_, params)| params["request"]["url"].as_str());
        addresses
            .filter(|url| !url.starts_with("data:") && !url.starts_with("blob:"))
            .collect()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // It may have ended by itself.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}
