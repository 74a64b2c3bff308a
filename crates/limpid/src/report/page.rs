//! The report's page: HTML, style and script in one file that asks for nothing.

/// The parts of the script in the order in which they build on each other.
const SCRIPT: [&str; 16] = [
    include_str!("../../page/dom.js"),
    include_str!("../../page/data.js"),
    include_str!("../../page/splats.js"),
    include_str!("../../page/motion.js"),
    include_str!("../../page/sort.js"),
    include_str!("../../page/camera.js"),
    include_str!("../../page/renderer.js"),
    include_str!("../../page/controls.js"),
    include_str!("../../page/overlay.js"),
    include_str!("../../page/address.js"),
    include_str!("../../page/viewer.js"),
    include_str!("../../page/wipe.js"),
    include_str!("../../page/blur.js"),
    include_str!("../../page/curves.js"),
    include_str!("../../page/tables.js"),
    include_str!("../../page/main.js"),
];

/// What a page is made of.
#[derive(Debug)]
pub(crate) struct Page<'a> {
    /// Text.
    pub(crate) title: &'a str,
    /// JSON.
    pub(crate) facts: &'a str,
    /// JSON.
    pub(crate) gallery: &'a str,
    /// Base64; empty where the splats lie beside the page.
    pub(crate) splats: &'a str,
}

impl Page<'_> {
    /// The file.
    pub(crate) fn html(&self) -> String {
        let script = SCRIPT.join("\n");
        // Only a page with a file beside it may ask for one, and only at its own place.
        let connect = if self.splats.is_empty() {
            "'self'"
        } else {
            "'none'"
        };
        fill(
            include_str!("../../page/page.html"),
            &[
                ("title", &text(self.title)),
                ("connect", connect),
                ("style", include_str!("../../page/style.css")),
                ("facts", &json(self.facts)),
                ("gallery", &json(self.gallery)),
                ("splats", self.splats),
                ("script", &script),
            ],
        )
    }
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

    #[test]
    fn hostile_names_stay_text() {
        let name = "</script><script>alert(1)</script><!--{{splats}}";
        let facts = serde_json::json!({ "name": name, "loss": f64::NAN }).to_string();
        let page = Page {
            title: name,
            facts: &facts,
            gallery: "{}",
            splats: "c3BsYXRz",
        };
        let html = page.html();
        assert!(!html.contains("<script>alert"), "no element of its own");
        assert_eq!(html.matches("c3BsYXRz").count(), 1, "a name is no place");
        assert!(html.contains("&lt;/script&gt;"), "the title is text");
        // What the page reads is what was written.
        let (_, rest) = html
            .split_once(r#"<script type="application/json" id="facts">"#)
            .expect("there");
        let (read, _) = rest.split_once("</script>").expect("it ends");
        let read: serde_json::Value = serde_json::from_str(read).expect("JSON");
        assert_eq!(
            (read["name"].as_str(), &read["loss"]),
            (Some(name), &serde_json::Value::Null)
        );
    }

    #[test]
    fn the_script_does_not_end_its_own_element() {
        assert!(
            SCRIPT
                .iter()
                .all(|part| !part.contains("</script") && !part.contains("<!--"))
        );
    }

    #[test]
    fn every_place_of_the_template_is_filled_and_nothing_is_fetched() {
        let page = Page {
            title: "t",
            facts: "{}",
            gallery: "{}",
            splats: "AAAA",
        };
        let html = page.html();
        assert!(!html.contains("{{"), "a place without a value");
        // The name of drawings' elements is no address.
        let html = html.replace("http://www.w3.org/2000/svg", "");
        for address in ["http:", "https:", "//cdn", "@import", "src=\"", "import("] {
            assert!(!html.contains(address), "{address}");
        }
        assert!(html.contains("default-src 'none'") && html.contains("connect-src 'none'"));
        let beside = Page { splats: "", ..page }.html();
        assert!(beside.contains("connect-src 'self'"));
    }
}
