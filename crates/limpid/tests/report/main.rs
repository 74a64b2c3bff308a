//! The report as a browser shows it: without an error, without a request, with the renderer's pixels.
//!
//! Needs Chromium (`chromium` where programs are found, or the environment variable `LIMPID_CHROMIUM`); without it, all of this
//! says that it skips.

#![cfg(unix)]

mod browser;
#[path = "../common/mod.rs"]
mod common;
mod watch;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use browser::{Browser, Outcome, chromium};
use common::{copy, skipped};
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../demo");
/// A report's pictures and the renderer's may differ by so much on the average, 8-bit units.
const MEAN_DIFFERENCE: f64 = 2.0;

/// Chromium, or a word that there is none.
fn browser_or_word(test: &str) -> Outcome<Option<std::path::PathBuf>> {
    let found = chromium();
    if found.is_none() {
        let why = "there is no Chromium (Debian's package chromium, or LIMPID_CHROMIUM=PROGRAM)";
        skipped(test, why)?;
    }
    Ok(found)
}

fn limpid(args: &[&str]) -> Outcome<String> {
    let ran = Command::new(env!("CARGO_BIN_EXE_limpid"))
        .args(args)
        .output()?;
    assert!(
        ran.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&ran.stderr)
    );
    Ok(String::from_utf8(ran.stdout)? + &String::from_utf8(ran.stderr)?)
}

/// The shortest run on the demo at half its size, moved into a scene with a hostile name.
fn train(folder: &Path) -> Outcome<std::path::PathBuf> {
    train_as(folder, "run", &["--downscale", "2", "--blur", "camera"])
}

/// The same with other words and in a folder of this name.
fn train_as(folder: &Path, name: &str, words: &[&str]) -> Outcome<std::path::PathBuf> {
    let scene = folder.join("<script>alert(1)<");
    copy(Path::new(DEMO), &scene)?;
    let out = folder.join(name);
    let [scene, to] = [&scene, &out].map(|path| path.to_str().expect("UTF-8"));
    let short = [
        "train",
        "--scene",
        scene,
        "--out",
        to,
        "--iterations",
        "200",
        "--set",
        "motion.first_fit_steps=40",
    ];
    limpid(&[&short[..], words].concat())?;
    Ok(out)
}

/// RGB of a view of the page's list at a time, row by row.
fn picture(browser: &mut Browser, view: usize, time: f64, show: &str) -> Outcome<Vec<u8>> {
    let code = format!(
        "(() => {{ let text = ''; for (const byte of report.viewer.picture({view}, {time}, '{show}')) text += String.fromCharCode(byte); \
         return btoa(text); }})()"
    );
    let encoded = browser.evaluate(&code)?;
    let rgba = STANDARD.decode(encoded.as_str().ok_or("base64")?)?;
    Ok(rgba
        .chunks_exact(4)
        .flat_map(|pixel| [pixel[0], pixel[1], pixel[2]])
        .collect())
}

/// Mean difference of pictures in 8-bit units.
fn difference(page: &[u8], renderer: &io::Image) -> f64 {
    assert_eq!(page.len(), renderer.pixels.len(), "of one size");
    let each = page.iter().zip(&renderer.pixels);
    each.map(|(a, b)| (f64::from(*a) - 255.0 * f64::from(*b)).abs())
        .sum::<f64>()
        / page.len() as f64
}

/// Where the light of a picture of movers has its middle, px.
fn centroid(rgb: &[u8], width: usize) -> [f64; 2] {
    let mut sums = [0.0; 3];
    for (i, pixel) in rgb.chunks_exact(3).enumerate() {
        let light = pixel.iter().map(|v| f64::from(*v)).sum::<f64>();
        sums[0] += light;
        sums[1] += light * (i % width) as f64;
        sums[2] += light * (i / width) as f64;
    }
    assert!(sums[0] > 0.0, "there is something to see");
    [sums[1] / sums[0], sums[2] / sums[0]]
}

/// A picture of the window for people to look at, where `LIMPID_SCREENSHOTS` names a folder.
fn keep_screenshot(browser: &mut Browser, name: &str) -> Outcome {
    if let Some(folder) = std::env::var_os("LIMPID_SCREENSHOTS") {
        fs::write(Path::new(&folder).join(name), browser.screenshot()?)?;
    }
    Ok(())
}

#[test]
fn a_report_shows_what_the_renderer_renders_and_asks_no_network() -> Outcome {
    let Some(program) = browser_or_word("the report in a browser")? else {
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let out = train(folder.path())?;
    let address = format!("file://{}#t=0", out.join("report.html").display());
    let mut browser = Browser::open(&program, &address, [1000, 900])?;

    // Right pixels at three times, each from the training and from the test camera of that time.
    let count = browser
        .evaluate("report.facts.train.length")?
        .as_u64()
        .ok_or("a number")? as usize;
    assert_eq!(count, 16);
    for index in [0, count / 2, count - 1] {
        for (kind, view) in [("train", index), ("test", count + index)] {
            let time = browser.evaluate(&format!("report.viewer.cameras[{view}].time"))?;
            let shown = picture(&mut browser, view, time.as_f64().ok_or("a time")?, "both")?;
            let rendered = io::read_image(&out.join(format!("renders/{kind}/{index:05}.png")))?;
            let mean = difference(&shown, &rendered);
            assert!(mean < MEAN_DIFFERENCE, "{kind} {index}: {mean:.2} of 255");
            assert!(
                rendered.pixels.iter().any(|v| *v > 0.2),
                "a picture with light in it"
            );
        }
    }
    // A mover's centroid moves; what stands still does not, from the same camera.
    let [early, late] = [0, count - 1].map(|time| picture(&mut browser, 0, time as f64, "movers"));
    let [early, late] = [centroid(&early?, 80), centroid(&late?, 80)];
    let moved = (early[0] - late[0]).hypot(early[1] - late[1]);
    assert!(moved > 1.0, "from {early:?} to {late:?}");
    let [early, late] = [0, count - 1].map(|time| picture(&mut browser, 0, time as f64, "static"));
    assert_eq!(early?, late?);

    // Time and view are in the address, and come back from it.
    browser.evaluate(
        "report.viewer.jump(3); report.viewer.controls.orbit(40, 10); report.viewer.setTime(5.25)",
    )?;
    browser.wait_for("location.hash.startsWith('#t=5.25&view=')")?;
    let hash = browser.evaluate("location.hash")?;
    let hash = hash.as_str().ok_or("text")?.to_owned();
    let place = browser.evaluate("report.viewer.controls.place.center")?;
    browser.evaluate("report.viewer.reset()")?;
    browser.wait_for("location.hash === '#t=0&cam=follow'")?;
    browser.evaluate(&format!("location.hash = '{hash}'"))?;
    browser.wait_for("report.viewer.time === 5.25")?;
    let again = browser.evaluate("report.viewer.controls.place.center")?;
    for axis in 0..3 {
        let [a, b] = [&place, &again].map(|center| center[axis].as_f64().unwrap_or(f64::NAN));
        assert!((a - b).abs() < 1e-4, "{place} and {again}");
    }
    assert_eq!(browser.evaluate("report.viewer.lens")?, 3);

    // Keys step through time, but not where they scroll a table.
    let press = |browser: &mut Browser, element: &str, key: &str| {
        browser.evaluate(&format!(
            "document.querySelector('{element}').dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))"
        ))
    };
    press(&mut browser, "#tables .scroll", "ArrowRight")?;
    assert_eq!(browser.evaluate("report.viewer.time")?, 5.25);
    press(&mut browser, "body", "ArrowRight")?;
    assert_eq!(browser.evaluate("report.viewer.time")?, 6.0);
    // A key that is held down walks no faster for being repeated.
    let times = browser.evaluate(
        "(() => { const { controls } = report.viewer; const before = controls.walkFor; let steps = 0; controls.walkFor = () => steps++; \
         for (let k = 0; k < 5; k++) document.body.dispatchEvent(new KeyboardEvent('keydown', { key: 'w', repeat: k > 0, bubbles: true })); \
         document.body.dispatchEvent(new KeyboardEvent('keyup', { key: 'w', bubbles: true })); controls.walkFor = before; return steps; })()",
    )?;
    assert_eq!(times, 1);
    // What is saved is whole, however small pictures are while it plays.
    let saved = browser.evaluate(
        "(() => { const { viewer } = report; viewer.play(); viewer.share = 0.3; viewer.canvas.toBlob = () => {}; viewer.save(); \
         delete viewer.canvas.toBlob; viewer.pause(); return viewer.canvas.width === viewer.width; })()",
    )?;
    assert_eq!(saved, true);

    // It plays, the other parts are there, and the name is text.
    let drawn = browser.evaluate("report.viewer.drawn")?;
    browser.evaluate("report.viewer.follow(); report.viewer.play()")?;
    browser.wait_for(&format!(
        "report.viewer.time !== 6 && report.viewer.drawn > {drawn} + 3"
    ))?;
    browser.evaluate("report.viewer.pause()")?;
    for holds in [
        "document.querySelectorAll('#curves svg').length === 4",
        "document.querySelectorAll('#tables tr.link').length === 32",
        "document.querySelectorAll('#notes li').length > 2",
        "document.querySelector('.wipe .over').naturalWidth === 80",
        "document.querySelectorAll('#blur svg circle').length > 10",
        "document.getElementById('title').textContent === '<script>alert(1)<'",
        // No element of the name's: facts, gallery, and the page's own; the splats' is gone once they are read.
        "[...document.scripts].length === 3",
    ] {
        browser.wait_for(holds)?;
    }
    keep_screenshot(&mut browser, "report.png")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());
    let requests = browser.requests();
    assert!(
        matches!(requests[..], [page] if page.starts_with("file://")),
        "the page itself: {requests:?}"
    );
    Ok(())
}

/// A run that is shown, until it is dropped.
struct Shown(std::process::Child);

impl Drop for Shown {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

#[test]
fn limpid_view_shows_a_run_without_a_report_and_splats_beside_the_page() -> Outcome {
    let Some(program) = browser_or_word("limpid view in a browser")? else {
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let out = train(folder.path())?;
    let report = out.join("report.html");
    fs::remove_file(&report)?;
    let mut child = Command::new(env!("CARGO_BIN_EXE_limpid"))
        .args(["view", "--no-open"])
        .arg(&out)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()?;
    let mut address = String::new();
    BufReader::new(child.stdout.take().ok_or("piped")?).read_line(&mut address)?;
    let _shown = Shown(child);
    let address = address.trim();
    assert!(address.starts_with("http://127.0.0.1:"), "{address}");

    // A scene that is too large for one page has its splats beside it.
    let html = fs::read_to_string(&report)?;
    let open = r#"<script type="application/octet-stream" id="splats">"#;
    let (before, rest) = html.split_once(open).ok_or("splats")?;
    let (encoded, after) = rest.split_once("</script>").ok_or("an end")?;
    let before = before.replace("connect-src 'none'", "connect-src 'self'");
    let before = before.replace(
        r#""scene_size":"#,
        r#""side_file":"report.splats","scene_size":"#,
    );
    let large = format!("{before}{open}</script>{after}");
    assert!(!encoded.is_empty() && large.contains("side_file"));
    let shown_from = |html: &str, address: &str, beside: bool| -> Outcome<Vec<u8>> {
        fs::write(&report, html)?;
        if beside {
            fs::write(out.join("report.splats"), STANDARD.decode(encoded)?)?;
        }
        let mut browser = Browser::open(&program, address, [700, 700])?;
        let pixels = picture(&mut browser, 2, 2.5, "both")?;
        assert!(browser.problems().is_empty(), "{:?}", browser.problems());
        let requests = browser.requests();
        let own = format!(
            "http://{}/",
            address
                .trim_start_matches("http://")
                .split('/')
                .next()
                .unwrap_or_default()
        );
        assert!(
            requests.iter().all(|url| url.starts_with(&own)),
            "{requests:?}"
        );
        assert_eq!(requests.len(), if beside { 2 } else { 1 }, "{requests:?}");
        Ok(pixels)
    };
    let inside = shown_from(&html, &format!("{address}#t=0"), false)?;
    let beside = shown_from(&large, &format!("{address}#t=0"), true)?;
    assert!(inside == beside, "the same scene from both");

    // From disk such a page says what to do.
    let mut browser = Browser::open(
        &program,
        &format!("file://{}", report.display()),
        [700, 700],
    )?;
    let message = browser.evaluate("document.getElementById('message').textContent")?;
    assert!(
        message
            .as_str()
            .is_some_and(|text| text.contains("limpid view")),
        "{message}"
    );
    // Nothing is offered that would do nothing.
    browser.wait_for("[...document.querySelectorAll('#scene button')].every((button) => button.offsetParent === null)")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());
    Ok(())
}

#[test]
fn runs_are_compared_at_the_same_view_and_edge() -> Outcome {
    let Some(program) = browser_or_word("limpid compare in a browser")? else {
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let hostile = "<img src=x onerror=alert(2)>";
    let half = ["--downscale", "2"];
    let camera = train(folder.path())?;
    let off = train_as(
        folder.path(),
        hostile,
        &[&half[..], &["--blur", "off"]].concat(),
    )?;
    let small = train_as(
        folder.path(),
        "small",
        &["--downscale", "5", "--blur", "kernels"],
    )?;
    let page = folder.path().join("compare.html");
    let [camera, off, small, to] =
        [&camera, &off, &small, &page].map(|path| path.to_str().expect("UTF-8"));
    // A score that is no number.
    let report = Path::new(off).join("report.html");
    let html = fs::read_to_string(&report)?;
    let score = r#""views":[{"name":"00000","psnr":"#;
    let (before, after) = html.split_once(score).ok_or("a score")?;
    let (_, after) = after.split_once(',').ok_or("another")?;
    fs::write(&report, format!("{before}{score}null,{after}"))?;

    let told = limpid(&["compare", camera, off, "--out", to])?;
    for part in [
        "test PSNR, dB",
        "seconds of training",
        "blur.model",
        "camera",
        hostile,
    ] {
        assert!(told.contains(part), "{part}: {told}");
    }
    assert!(!told.contains("warning"), "{told}");
    let mut browser = Browser::open(
        &program,
        &format!("file://{}", page.display()),
        [1100, 1000],
    )?;
    for holds in [
        "document.querySelectorAll('.pane').length === 2",
        "[...document.querySelectorAll('.wipe img')].every((image) => image.naturalWidth === 80)",
        "document.querySelectorAll('#tables tr.link').length === 32",
        "document.getElementById('tables').textContent.includes('–')",
        "document.querySelectorAll('#figures .best').length > 0",
        "[...document.querySelectorAll('#others td')].some((cell) => cell.textContent === 'blur.model')",
        "document.querySelectorAll('#figures th')[2].textContent === '<img src=x onerror=alert(2)>'",
        // The data and the page's own.
        "document.scripts.length === 2",
    ] {
        browser.wait_for(holds)?;
    }
    // All panes show the same frame, with one input and a sharp render each, and have their edge at one place.
    let pictures = "[...document.querySelectorAll('.wipe img')].map((image) => image.src)";
    browser.evaluate("comparison.wipe.set(3)")?;
    let at_three = browser.evaluate(pictures)?;
    assert!(at_three[1] == at_three[3], "the same blurry frame");
    assert!(at_three[0] != at_three[2], "a sharp render each");
    browser.evaluate(
        "(() => { const [, input] = document.querySelectorAll('.wipe input'); input.value = 20; input.dispatchEvent(new Event('input')); })()",
    )?;
    let edges = "[...document.querySelectorAll('.wipe')].map((pane) => pane.style.getPropertyValue('--edge')).join()";
    assert_eq!(browser.evaluate(edges)?, "20%,20%");
    // A line of the scores leads to its view.
    browser.evaluate("document.querySelector('#tables tr.link').click()")?;
    browser.wait_for("comparison.wipe.views[comparison.wipe.index].test")?;
    browser.evaluate("comparison.wipe.set(3); scrollTo(0, 0)")?;
    keep_screenshot(&mut browser, "compare.png")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());
    let requests = browser.requests();
    assert!(
        matches!(requests[..], [page] if page.starts_with("file://")),
        "the page itself: {requests:?}"
    );

    // Other sizes are told, and no score is the best.
    let told = limpid(&["compare", camera, small, "--out", to])?;
    assert!(
        told.contains("warning: small has pictures of 32 × 18"),
        "{told}"
    );
    assert!(!told.contains('*'), "{told}");
    let mut browser = Browser::open(&program, &format!("file://{}", page.display()), [700, 700])?;
    browser.wait_for("document.querySelectorAll('#warnings li').length === 1")?;
    browser.wait_for("document.querySelectorAll('.best').length === 0")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());

    // The kernel of another place is to be had by keys too.
    let report = Path::new(small).join("report.html");
    let mut browser = Browser::open(
        &program,
        &format!("file://{}#t=0", report.display()),
        [700, 700],
    )?;
    let mark = "document.querySelector('.wipe .mark')";
    let before = browser.evaluate(&format!("{mark}.style.left"))?;
    browser.evaluate(&format!(
        "{mark}.dispatchEvent(new KeyboardEvent('keydown', {{ key: 'ArrowRight', bubbles: true }}))"
    ))?;
    browser.wait_for(&format!(
        "{mark}.style.left !== '{}' && document.activeElement === {mark} && report.viewer.time === 0",
        before.as_str().ok_or("a place")?
    ))?;
    keep_screenshot(&mut browser, "kernels.png")?;
    assert!(browser.problems().is_empty(), "{:?}", browser.problems());
    Ok(())
}
