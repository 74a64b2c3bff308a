//! Lines that are copied into a shell.

/// A word as a POSIX shell takes it.
pub(crate) fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=+%,@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_a_shell_keep_their_meaning() {
        for plain in ["blur.kernel_size=7", "out/color/%05d.png"] {
            assert_eq!(quoted(plain), plain);
        }
        for (word, line) in [
            ("", "''"),
            ("a b", "'a b'"),
            ("pad=ceil(iw/2)*2", "'pad=ceil(iw/2)*2'"),
            ("it's; rm -rf $HOME", r"'it'\''s; rm -rf $HOME'"),
        ] {
            assert_eq!(quoted(word), line);
        }
    }
}
