//! Serves files to this machine's own browser, those of a folder or some in memory: nothing else, to nobody else.

use std::fs::File;
use std::io::{Cursor, ErrorKind, Read, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A request's head is no longer than this.
const MOST_HEAD: usize = 8192;
/// More readers at a time are turned away.
const MOST_READERS: usize = 32;
/// Nobody is waited for longer than this.
const PATIENCE: Duration = Duration::from_secs(10);

/// Files that are served on the loopback address.
#[derive(Debug)]
pub(crate) struct Server {
    listener: TcpListener,
    address: SocketAddr,
    source: Source,
}

/// Where files come from.
#[derive(Debug)]
enum Source {
    /// A folder, without links and `..`, and the name of what is served as `/`.
    Folder(PathBuf, &'static str),
    Memory(Arc<Held>),
}

/// Files in memory, which may change while they are served.
#[derive(Debug, Default)]
pub(crate) struct Held(Mutex<Files>);

#[derive(Debug, Default)]
struct Files {
    tag: usize,
    files: Vec<HeldFile>,
    asked: Option<Instant>,
}

#[derive(Debug)]
struct HeldFile {
    name: &'static str,
    bytes: Arc<[u8]>,
    /// Somebody has it.
    taken: bool,
}

impl Held {
    /// Serves these files from now on; the one without a name is served as `/`. The tag tells them from those before.
    pub(crate) fn put(&self, tag: usize, files: Vec<(&'static str, Vec<u8>)>) {
        let files = files
            .into_iter()
            .map(|(name, bytes)| HeldFile {
                name,
                bytes: bytes.into(),
                taken: false,
            })
            .collect();
        let mut now = self.now();
        (now.tag, now.files) = (tag, files);
    }

    /// Whether anybody asked for something since then.
    pub(crate) fn is_asked_since(&self, then: Instant) -> bool {
        self.now().asked.is_some_and(|asked| asked > then)
    }

    /// Whether each of the files was given to somebody.
    pub(crate) fn is_taken(&self) -> bool {
        self.now().files.iter().all(|file| file.taken)
    }

    fn note_taken(&self, tag: usize, name: &str) {
        let mut now = self.now();
        if now.tag == tag {
            let mut files = now.files.iter_mut();
            if let Some(file) = files.find(|file| file.name == name) {
                file.taken = true;
            }
        }
    }

    fn now(&self) -> MutexGuard<'_, Files> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A file that is about to be sent.
struct Found {
    kind: &'static str,
    length: u64,
    tag: Option<usize>,
    content: Box<dyn Read>,
}

impl Server {
    /// A folder at a port of 127.0.0.1; port 0 is any that is free.
    pub(crate) fn of_folder(root: &Path, front: &'static str, port: u16) -> std::io::Result<Self> {
        Self::new(Source::Folder(root.canonicalize()?, front), port)
    }

    /// The same of what is held in memory.
    pub(crate) fn of_memory(held: Arc<Held>, port: u16) -> std::io::Result<Self> {
        Self::new(Source::Memory(held), port)
    }

    fn new(source: Source, port: u16) -> std::io::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))?;
        Ok(Self {
            address: listener.local_addr()?,
            listener,
            source,
        })
    }

    /// Where it is.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Serves until the program ends.
    pub(crate) fn run(self) {
        let server = Arc::new(self);
        let readers = Arc::new(AtomicUsize::new(0));
        for stream in server.listener.incoming() {
            // A connection that failed before it began is nobody's loss.
            let Ok(stream) = stream else { continue };
            if readers.fetch_add(1, Ordering::Relaxed) >= MOST_READERS {
                readers.fetch_sub(1, Ordering::Relaxed);
                continue;
            }
            let (server, readers) = (server.clone(), readers.clone());
            std::thread::spawn(move || {
                // A reader that went away is no error.
                server.answer(stream).ok();
                readers.fetch_sub(1, Ordering::Relaxed);
            });
        }
    }

    fn answer(&self, mut stream: TcpStream) -> std::io::Result<()> {
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let head = read_head(&mut stream)?;
        let asked = self.asked(&head);
        match asked.and_then(|(name, with_body)| Ok((self.find(&name)?, name, with_body))) {
            Ok((found, name, with_body)) => {
                let Found {
                    kind,
                    length,
                    tag,
                    content,
                } = found;
                let etag = tag.map_or_else(String::new, |tag| format!("ETag: \"{tag}\"\r\n"));
                write!(
                    stream,
                    "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nCache-Control: no-store\r\n{etag}\
                     X-Content-Type-Options: nosniff\r\nCross-Origin-Resource-Policy: same-origin\r\nConnection: close\r\n\r\n"
                )?;
                if with_body {
                    // Not more than was promised, should it grow.
                    std::io::copy(&mut content.take(length), &mut stream)?;
                    stream.flush()?;
                    if let (Source::Memory(held), Some(tag)) = (&self.source, tag) {
                        held.note_taken(tag, &name);
                    }
                }
            }
            Err(status) => write!(
                stream,
                "HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
            )?,
        }
        stream.flush()
    }

    /// The name of the file that a request asks for, and whether its content is wanted; else the status line.
    fn asked(&self, head: &str) -> Result<(String, bool), &'static str> {
        let mut lines = head.split("\r\n");
        let mut words = lines.next().unwrap_or_default().split(' ');
        let (method, target) = (
            words.next().unwrap_or_default(),
            words.next().unwrap_or_default(),
        );
        let with_body = match method {
            "GET" => true,
            "HEAD" => false,
            _ => return Err("405 Method Not Allowed"),
        };
        // A page of another site that has its own name point here must not read what is served.
        let port = self.address.port();
        let host = lines
            .filter_map(|line| line.split_once(':'))
            .find(|(name, _)| name.eq_ignore_ascii_case("host"));
        let host = host.map_or("", |(_, host)| host.trim());
        // Browsers leave 80 out.
        let ours = ["127.0.0.1", "localhost"]
            .iter()
            .any(|name| host == format!("{name}:{port}") || port == 80 && host == *name);
        if !ours {
            return Err("403 Forbidden");
        }
        let path = target.split(['?', '#']).next().unwrap_or_default();
        let name = path
            .strip_prefix('/')
            .and_then(decoded)
            .ok_or("400 Bad Request")?;
        Ok((name, with_body))
    }

    /// The file of a name.
    fn find(&self, name: &str) -> Result<Found, &'static str> {
        match &self.source {
            Source::Folder(root, front) => {
                in_folder(root, if name.is_empty() { front } else { name })
            }
            Source::Memory(held) => {
                let mut now = held.now();
                now.asked = Some(Instant::now());
                let file = now.files.iter().find(|file| file.name == name);
                let bytes = file.ok_or("404 Not Found")?.bytes.clone();
                Ok(Found {
                    kind: content_type(Path::new(if name.is_empty() { "a.html" } else { name })),
                    length: bytes.len() as u64,
                    tag: Some(now.tag),
                    content: Box::new(Cursor::new(bytes)),
                })
            }
        }
    }
}

/// A file of a folder.
fn in_folder(root: &Path, name: &str) -> Result<Found, &'static str> {
    // No `..`, nothing hidden, no separator of another system.
    if name
        .split('/')
        .any(|part| part.is_empty() || part.starts_with('.'))
        || name.contains(['\\', ':', '\0'])
    {
        return Err("404 Not Found");
    }
    // Where a link leads out of the folder, it leads nowhere.
    let found = root
        .join(name)
        .canonicalize()
        .map_err(|_| "404 Not Found")?;
    if !found.starts_with(root) || !found.is_file() {
        return Err("404 Not Found");
    }
    let open = || -> std::io::Result<Found> {
        let file = File::open(&found)?;
        Ok(Found {
            kind: content_type(&found),
            length: file.metadata()?.len(),
            tag: None,
            content: Box::new(file),
        })
    };
    open().map_err(|_| "404 Not Found")
}

/// Reads up to the empty line.
fn read_head(stream: &mut TcpStream) -> std::io::Result<String> {
    let mut head = Vec::new();
    let mut piece = [0; 1024];
    while !head.windows(4).any(|end| end == b"\r\n\r\n") {
        let count = stream.read(&mut piece)?;
        if count == 0 || head.len() + count > MOST_HEAD {
            return Err(ErrorKind::InvalidData.into());
        }
        head.extend(&piece[..count]);
    }
    String::from_utf8(head).map_err(|_| ErrorKind::InvalidData.into())
}

/// A path without its `%41`; `None` where that is no text.
fn decoded(path: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = path.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(if byte == b'%' {
            let digits = [rest.next()?, rest.next()?];
            let digits = str::from_utf8(&digits)
                .ok()
                .filter(|d| d.bytes().all(|b| b.is_ascii_hexdigit()))?;
            u8::from_str_radix(digits, 16).ok()?
        } else {
            byte
        });
    }
    String::from_utf8(bytes).ok()
}

fn content_type(path: &Path) -> &'static str {
    match path.extension().and_then(|e| e.to_str()) {
        Some("html") => "text/html; charset=utf-8",
        Some("json") => "application/json",
        Some("png") => "image/png",
        Some("jsonl" | "txt") => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Outcome = Result<(), Box<dyn std::error::Error>>;

    /// What comes back for these bytes.
    fn reply(address: SocketAddr, request: &str) -> std::io::Result<String> {
        let mut stream = TcpStream::connect(address)?;
        stream.write_all(request.as_bytes())?;
        let mut text = String::new();
        stream.read_to_string(&mut text)?;
        Ok(text)
    }

    #[test]
    fn only_files_of_the_folder_are_served_and_only_to_this_machine() -> Outcome {
        let folder = tempfile::tempdir()?;
        let run = folder.path().join("run");
        std::fs::create_dir_all(run.join("renders"))?;
        std::fs::write(run.join("report.html"), "the report")?;
        std::fs::write(run.join("renders/a b.png"), "picture")?;
        std::fs::write(run.join(".lock"), "hidden")?;
        std::fs::write(folder.path().join("secret"), "secret")?;
        #[cfg(unix)]
        std::os::unix::fs::symlink(folder.path().join("secret"), run.join("link"))?;
        let server = Server::of_folder(&run, "report.html", 0)?;
        let address = server.address();
        assert!(address.ip().is_loopback(), "{address}");
        std::thread::spawn(|| server.run());
        let get = |path: &str| {
            reply(
                address,
                &format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n"),
            )
        };

        let front = get("/")?;
        assert!(
            front.starts_with("HTTP/1.1 200") && front.ends_with("\r\n\r\nthe report"),
            "{front}"
        );
        assert!(front.contains("text/html"), "{front}");
        assert!(get("/report.html?x=1")?.ends_with("the report"));
        assert!(get("/renders/a%20b.png")?.ends_with("picture"));
        for path in [
            "/../secret",
            "/%2e%2e/secret",
            "/renders/../../secret",
            "/renders/..%2f..%2fsecret",
            "/..%5csecret",
            "//etc/passwd",
            "/%2fetc/passwd",
            "/.lock",
            "/link",
            "/renders",
            "/none",
            "/report.html%00",
        ] {
            let refused = get(path)?;
            assert!(refused.starts_with("HTTP/1.1 404"), "{path}: {refused}");
            assert!(!refused.contains("secret"), "{path}: {refused}");
        }
        for path in ["report.html", "/%zz", "/%+1", "/%f"] {
            assert!(get(path)?.starts_with("HTTP/1.1 400"), "{path}");
        }
        let other = reply(address, "GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")?;
        assert!(other.starts_with("HTTP/1.1 403"), "{other}");
        let other = reply(address, "GET / HTTP/1.1\r\n\r\n")?;
        assert!(other.starts_with("HTTP/1.1 403"), "{other}");
        let post = reply(
            address,
            &format!("POST / HTTP/1.1\r\nHost: {address}\r\n\r\n"),
        )?;
        assert!(post.starts_with("HTTP/1.1 405"), "{post}");
        let head = reply(
            address,
            &format!("HEAD / HTTP/1.1\r\nHost: {address}\r\n\r\n"),
        )?;
        assert!(
            head.contains("Content-Length: 10") && head.ends_with("\r\n\r\n"),
            "{head}"
        );
        Ok(())
    }

    #[test]
    fn files_in_memory_change_while_they_are_served_and_are_known_by_their_tag() -> Outcome {
        let held = Arc::new(Held::default());
        let began = Instant::now();
        held.put(
            7,
            vec![("", b"one".to_vec()), ("a.splats", b"bytes".to_vec())],
        );
        let server = Server::of_memory(held.clone(), 0)?;
        let address = server.address();
        std::thread::spawn(|| server.run());
        let ask = |method: &str, path: &str| {
            let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\n\r\n");
            reply(address, &head)
        };
        assert!(!held.is_asked_since(began));
        let head = ask("HEAD", "/")?;
        assert!(
            head.contains("ETag: \"7\"") && head.ends_with("\r\n\r\n"),
            "{head}"
        );
        assert!(
            held.is_asked_since(began) && !held.is_taken(),
            "only looked at"
        );
        let front = ask("GET", "/")?;
        assert!(
            front.contains("text/html") && front.ends_with("\r\n\r\none"),
            "{front}"
        );
        assert!(!held.is_taken(), "one of two");
        assert!(ask("GET", "/a.splats")?.ends_with("\r\n\r\nbytes"));
        for path in ["/none", "/../a.splats", "/etc/passwd", "/Cargo.toml"] {
            assert!(ask("GET", path)?.starts_with("HTTP/1.1 404"), "{path}");
        }
        for _ in 0..200 {
            if held.is_taken() {
                break;
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(held.is_taken());
        held.put(8, vec![("", b"two".to_vec())]);
        assert!(!held.is_taken());
        let front = ask("GET", "/")?;
        assert!(
            front.contains("ETag: \"8\"") && front.ends_with("two"),
            "{front}"
        );
        assert!(
            ask("GET", "/a.splats")?.starts_with("HTTP/1.1 404"),
            "it is gone"
        );
        Ok(())
    }
}
