//! JSON in. What is wrong comes back with its field and its line.

use std::path::Path;

use serde::de::DeserializeOwned;

use crate::IoError;
use crate::bytes::read_file;

/// Reads a JSON file.
///
/// # Errors
/// [`IoError::Access`]; [`IoError::Json`] when it is broken or holds something else.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, IoError> {
    parse_json(&read_file(path)?, path)
}

/// Reads JSON that is from the file `path`.
///
/// # Errors
/// [`IoError::Json`] when it is broken or holds something else.
pub fn parse_json<T: DeserializeOwned>(text: &[u8], path: &Path) -> Result<T, IoError> {
    let mut json = serde_json::Deserializer::from_slice(text);
    let (key, error) = match serde_path_to_error::deserialize(&mut json) {
        Ok(value) => match json.end() {
            Ok(()) => return Ok(value),
            Err(error) => (String::new(), error),
        },
        Err(error) => (key(error.path()), error.into_inner()),
    };
    let (line, column) = (error.line(), error.column());
    let word = not_finite_at(text, line, column).filter(|_| error.is_syntax());
    let problem = match word {
        Some(word) => format!("{word} is no number in JSON"),
        None => {
            let told = error.to_string();
            let place = format!(" at line {line} column {column}");
            told.strip_suffix(&place).unwrap_or(&told).to_owned()
        }
    };
    Err(IoError::Json {
        key,
        problem,
        line,
        column,
        path: path.into(),
    })
}

/// A field as one would write it; empty where it is the whole.
fn key(path: &serde_path_to_error::Path) -> String {
    if path.iter().len() == 0 {
        return String::new();
    }
    path.to_string()
}

/// The word at a place, if it is one that Python writes for a number that is not finite.
fn not_finite_at(text: &[u8], line: usize, column: usize) -> Option<&str> {
    let line = text.split(|&b| b == b'\n').nth(line.checked_sub(1)?)?;
    let is_word = |b: &u8| b.is_ascii_alphabetic() || *b == b'-';
    // The column counts from 1, and may be that of the word's first letter or of its last.
    let at = column.checked_sub(1)?.min(line.len());
    let start = line[..at]
        .iter()
        .rposition(|b| !is_word(b))
        .map_or(0, |i| i + 1);
    let length = line[start..].iter().take_while(|b| is_word(b)).count();
    let word = std::str::from_utf8(&line[start..start + length]).ok()?;
    let name = word.trim_start_matches('-').to_ascii_lowercase();
    ["nan", "infinity", "inf"]
        .contains(&name.as_str())
        .then_some(word)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    #[test]
    fn what_is_no_json_number_is_named_with_its_field() {
        for (word, value) in [("NaN", "NaN"), ("-Infinity", " -Infinity"), ("nan", "nan")] {
            let text = format!("{{\n \"a\": [1.0],\n \"b\": [2.0, {value}]\n}}");
            let read =
                parse_json::<BTreeMap<String, Vec<f64>>>(text.as_bytes(), Path::new("x.json"));
            let told = read.expect_err("no JSON").to_string();
            for part in [
                "line 3",
                "`b[1]`",
                &format!("{word} is no number in JSON"),
                "x.json",
            ] {
                assert!(told.contains(part), "{told}");
            }
        }
    }

    #[test]
    fn other_mistakes_have_their_place_once() {
        let read = |text: &str| {
            let read = parse_json::<BTreeMap<String, f64>>(text.as_bytes(), Path::new("x.json"));
            read.map_err(|e| e.to_string())
        };
        assert_eq!(read("{\"a\": 1}").map(|map| map["a"]), Ok(1.0));
        let told = read("{\"a\": \"b\"}").expect_err("no number");
        assert!(
            told.contains("`a`") && told.contains("invalid type"),
            "{told}"
        );
        assert_eq!(told.matches("line 1").count(), 1, "{told}");
        let told = read("{\"a\": 1} {").expect_err("more than one value");
        assert!(told.contains("trailing characters"), "{told}");
        assert!(read("").is_err());
        // The words are no fault where they stand in a text.
        let told = read("{\"NaN\": \"NaN\"}").expect_err("no number");
        assert!(told.contains("invalid type"), "{told}");
    }
}
