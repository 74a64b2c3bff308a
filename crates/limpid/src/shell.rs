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
        assert_eq!(quoted("blur.kernel_size=7"), "blur.kernel_size=7");
        assert_eq!(quoted("a b"), "'a b'");
        assert_eq!(quoted("it's; rm -rf $HOME"), r"'it'\''s; rm -rf $HOME'");
        assert_eq!(quoted(""), "''");
    }

    #[test]
    fn a_line_to_copy_survives_the_shell() {
        assert_eq!(quoted("out/color/%05d.png"), "out/color/%05d.png");
        assert_eq!(quoted("my run's"), r"'my run'\''s'");
        assert_eq!(quoted("pad=ceil(iw/2)*2"), "'pad=ceil(iw/2)*2'");
        assert_eq!(quoted(""), "''");
    }
}
