//! `limpid train --watch`: the report of a run as it is while it trains.

use crate::browser::{Browser, Outcome};
use crate::{DEMO, Shown, browser_or_word, keep_screenshot, limpid, picture};
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::path::Path;
use std::process::{Command, Stdio};

/// A run that trains and is watched, and its address.
fn watched(folder: &Path, name: &str, words: &[&str]) -> Outcome<(Shown, String)> {
    let out = folder.join(name);
    let mut child = Command::new(env!("CARGO_BIN_EXE_limpid"))
        .args(["train", "--scene", DEMO, "--out"])
        .arg(&out)
        .args(words)
        .stderr(Stdio::piped())
        .spawn()?;
    let lines = BufReader::new(child.stderr.take().ok_or("piped")?).lines();
    let shown = Shown(child);
    for line in lines {
        if let Some((_, address)) = line?.split_once("watch it at ") {
            // Nobody reads the rest.
            return Ok((shown, address.to_owned()));
        }
    }
    Err("no address".into())
}

/// Looks at the report of a run every few milliseconds until it is that of the whole run: the tags of all that were seen, and the
/// last page.
fn followed(address: &str) -> Outcome<(Vec<String>, String)> {
    let mut tags = Vec::new();
    loop {
        let head = asked(address, "HEAD")?;
        let tag = head.lines().find(|line| line.starts_with("ETag: "));
        let tag = tag.ok_or("a tag")?.to_owned();
        if !tags.contains(&tag) {
            tags.push(tag);
            let page = asked(address, "GET")?;
            assert!(page.contains("id=\"facts\""), "a report");
            if !page.contains("\"live\":{") {
                return Ok((tags, page));
            }
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

/// What a server answers.
fn asked(address: &str, method: &str) -> Outcome<String> {
    let host = address.trim_start_matches("http://").trim_end_matches('/');
    let mut stream = std::net::TcpStream::connect(host)?;
    write!(stream, "{method} / HTTP/1.1\r\nHost: {host}\r\n\r\n")?;
    let mut reply = String::new();
    stream.read_to_string(&mut reply)?;
    Ok(reply)
}

#[test]
fn a_run_that_is_watched_comes_out_the_same_and_ends_with_its_report() -> Outcome {
    let folder = tempfile::tempdir()?;
    let words = |iterations: &'static str| {
        [
            "--downscale",
            "5",
            "--blur",
            "camera",
            "--iterations",
            iterations,
            "--set",
            "motion.first_fit_steps=40",
        ]
    };
    // A snapshot before the first iteration, one on the way and the whole report. That on the way comes after 99 times what the
    // first one took: how many iterations that is depends on the machine, and on what else it does.
    let mut found = None;
    for iterations in ["500", "2000", "8000"] {
        let (mut run, address) = watched(
            folder.path(),
            iterations,
            &[&words(iterations)[..], &["--watch=0"]].concat(),
        )?;
        assert!(address.starts_with("http://127.0.0.1:"), "{address}");
        let (tags, last) = followed(&address)?;
        assert!(last.contains("\"metrics\":{"), "with scores");
        assert!(run.0.wait()?.success());
        if tags.len() >= 3 {
            found = Some(iterations);
            break;
        }
    }
    let iterations = found.ok_or("no snapshot on the way")?;
    let [alone, out] = ["alone", iterations].map(|name| folder.path().join(name));
    let to = alone.to_str().ok_or("UTF-8")?;
    let train = ["train", "--scene", DEMO, "--out", to];
    limpid(&[&train[..], &words(iterations)].concat())?;
    for file in [
        "scene.ply",
        "renders/test/00003.png",
        "renders/blurred/00007.png",
    ] {
        assert!(
            fs::read(alone.join(file))? == fs::read(out.join(file))?,
            "{file}"
        );
    }
    Ok(())
}

#[test]
fn a_page_follows_a_run_and_keeps_its_time_and_view() -> Outcome {
    let Some(program) = browser_or_word("limpid train --watch in a browser")? else {
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let words = [
        "--downscale",
        "5",
        "--blur",
        "camera",
        "--iterations",
        "6000",
        "--watch=1",
    ];
    let (mut run, address) = watched(folder.path(), "run", &words)?;
    let mut browser = Browser::open(&program, &format!("{address}#t=0"), [1000, 900])?;
    browser.evaluate(
        "report.viewer.jump(3); report.viewer.controls.orbit(40, 10); report.viewer.setTime(5.25); report.wipe.edge(30); \
         document.querySelector('#about details').open = true",
    )?;
    let place = browser.evaluate("report.viewer.controls.place.center")?;
    let before = browser.evaluate("report.facts.live.snapshot")?;
    browser.wait_for(&format!("report.facts.live.snapshot > {before}"))?;
    browser.wait_for(
        "report.facts.iterations > 10 && report.viewer.scene.count === report.facts.gaussians",
    )?;
    assert_eq!(browser.evaluate("report.viewer.time")?, 5.25);
    assert_eq!(
        browser.evaluate("report.viewer.controls.place.center")?,
        place
    );
    for holds in [
        "document.querySelector('.wipe').style.getPropertyValue('--edge') === '30%'",
        "document.querySelectorAll('#view option').length === 5",
        "document.querySelectorAll('#curves svg').length === 4",
        "document.querySelectorAll('#about .pair').length > 0 && document.querySelectorAll('#about details[open]').length === 1",
        "document.getElementById('live').textContent.startsWith('being trained: iteration ')",
    ] {
        browser.wait_for(holds)?;
    }
    // What it shows is a scene.
    let shown = picture(&mut browser, 3, 3.0, "both")?;
    assert!(shown.iter().any(|v| *v > 50), "light");
    keep_screenshot(&mut browser, "watch.png")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());
    let own = browser
        .requests()
        .into_iter()
        .all(|url| url.starts_with(&address));
    assert!(own, "{:?}", browser.requests());

    // A page whose run is another one by now begins anew.
    browser.evaluate("report.facts.name = 'of another run'; window.stays = true")?;
    browser.wait_for("typeof stays === 'undefined' && typeof report === 'object'")?;
    browser.wait_for("report.ready.then(() => report.facts.name !== 'of another run')")?;

    // It says so when there is nothing to follow any more.
    run.0.kill()?;
    run.0.wait()?;
    browser.wait_for("document.getElementById('live').textContent.includes('does not answer')")?;
    Ok(())
}
