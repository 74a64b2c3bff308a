//! Pages that open from disk: HTML, style, script and data in one file that asks for nothing.

/// What a kind of page is made of, beside its data.
#[derive(Debug)]
pub(crate) struct Kind {
    body: &'static str,
    /// The parts of the script in the order in which they build on each other.
    script: &'static [&'static str],
}

/// A run's report.
pub(crate) const REPORT: Kind = Kind {
    body: include_str!("../page/report.html"),
    script: &[
        include_str!("../page/dom.js"),
        include_str!("../page/data.js"),
        include_str!("../page/splats.js"),
        include_str!("../page/motion.js"),
        include_str!("../page/sort.js"),
        include_str!("../page/camera.js"),
        include_str!("../page/renderer.js"),
        include_str!("../page/controls.js"),
        include_str!("../page/overlay.js"),
        include_str!("../page/address.js"),
        include_str!("../page/viewer.js"),
        include_str!("../page/wipe.js"),
        include_str!("../page/blur.js"),
        include_str!("../page/curves.js"),
        include_str!("../page/tables.js"),
        include_str!("../page/live.js"),
        include_str!("../page/main.js"),
    ],
};

/// Several runs side by side.
pub(crate) const COMPARISON: Kind = Kind {
    body: include_str!("../page/compare.html"),
    script: &[
        include_str!("../page/dom.js"),
        include_str!("../page/data.js"),
        include_str!("../page/wipe.js"),
        include_str!("../page/tables.js"),
        include_str!("../page/compare.js"),
    ],
};

/// A page and its data.
#[derive(Debug)]
pub(crate) struct Page<'a> {
    pub(crate) kind: &'a Kind,
    /// Text.
    pub(crate) title: &'a str,
    /// JSON by the names under which the script finds it.
    pub(crate) data: &'a [(&'a str, &'a str)],
    /// A scene in base64, for a page that shows one; empty where it lies beside the page.
    pub(crate) splats: Option<&'a str>,
}

impl Page<'_> {
    /// The file.
    pub(crate) fn html(&self) -> String {
        // Only a page with a file beside it may ask for one, and only at its own place.
        let connect = if self.splats == Some("") {
            "'self'"
        } else {
            "'none'"
        };
        let body = fill(
            self.kind.body,
            &[("frames", include_str!("../page/frames.html"))],
        );
        let mut data = String::new();
        for (id, text) in self.data {
            data.extend([&opening(id), &json(text), "</script>\n"]);
        }
        if let Some(splats) = self.splats {
            let open = r#"<script type="application/octet-stream" id="splats">"#;
            data.extend([open, splats, "</script>\n"]);
        }
        fill(
            include_str!("../page/shell.html"),
            &[
                ("title", &text(self.title)),
                ("connect", connect),
                ("style", include_str!("../page/style.css")),
                ("body", &body),
                ("data", &data),
                ("script", &self.kind.script.join("\n")),
            ],
        )
    }
}

/// What begins a page's data of a name.
fn opening(id: &str) -> String {
    format!(r#"<script type="application/json" id="{id}">"#)
}

/// The JSON that a page holds under a name.
pub(crate) fn held<'a>(html: &'a str, id: &str) -> Option<&'a str> {
    let (_, rest) = html.split_once(&opening(id))?;
    Some(rest.split_once("</script>")?.0)
}

/// Puts values in the places of `{{name}}`. What a value holds is not looked at again.
fn fill(template: &str, values: &[(&str, &str)]) -> String {
    let mut page = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once("{{") {
        let (name, after) = after.split_once("}}").unwrap_or((after, ""));
        page.push_str(before);
        let value = values.iter().find(|(key, _)| *key == name);
        page.push_str(value.map_or("", |(_, value)| value));
        rest = after;
    }
    page.push_str(rest);
    page
}

/// Text in HTML.
fn text(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// JSON in a script element: nothing in it ends or begins an element or a comment.
fn json(json: &str) -> String {
    json.replace('<', "\\u003c")
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [Kind; 2] = [REPORT, COMPARISON];

    #[test]
    fn hostile_names_stay_text() {
        let name = "</script><script>alert(1)</script><!--{{splats}}";
        let facts = serde_json::json!({ "name": name, "loss": f64::NAN }).to_string();
        for kind in &KINDS {
            let page = Page {
                kind,
                title: name,
                data: &[("facts", &facts), ("gallery", "{}")],
                splats: Some("c3BsYXRz"),
            };
            let html = page.html();
            assert!(!html.contains("<script>alert"), "no element of its own");
            assert_eq!(html.matches("c3BsYXRz").count(), 1, "a name is no place");
            assert!(html.contains("&lt;/script&gt;"), "the title is text");
            // What the page reads is what was written.
            let read = held(&html, "facts").expect("there");
            let read: serde_json::Value = serde_json::from_str(read).expect("JSON");
            assert_eq!(
                (read["name"].as_str(), &read["loss"]),
                (Some(name), &serde_json::Value::Null)
            );
            assert_eq!(
                (held(&html, "gallery"), held(&html, "none")),
                (Some("{}"), None)
            );
        }
    }

    #[test]
    fn the_script_does_not_end_its_own_element() {
        let mut parts = KINDS.iter().flat_map(|kind| kind.script);
        assert!(parts.all(|part| !part.contains("</script") && !part.contains("<!--")));
    }

    #[test]
    fn every_place_of_the_template_is_filled_and_nothing_is_fetched() {
        for kind in &KINDS {
            let page = Page {
                kind,
                title: "t",
                data: &[("facts", "{}")],
                splats: Some("AAAA"),
            };
            let html = page.html();
            assert!(!html.contains("{{"), "a place without a value");
            // The name of drawings' elements is no address.
            let html = html.replace("http://www.w3.org/2000/svg", "");
            for address in ["http:", "https:", "//cdn", "@import", "src=\"", "import("] {
                assert!(!html.contains(address), "{address}");
            }
            assert!(html.contains("default-src 'none'") && html.contains("connect-src 'none'"));
            let without = Page {
                splats: None,
                ..page
            }
            .html();
            assert!(without.contains("connect-src 'none'") && !without.contains("id=\"splats\""));
            let beside = Page {
                splats: Some(""),
                ..page
            }
            .html();
            assert!(beside.contains("connect-src 'self'"));
        }
    }
}
