//! Rust files word by word.

use std::fs;
use std::iter::Peekable;
use std::path::{Path, PathBuf};
use std::vec::IntoIter;

use proc_macro2::{Delimiter, Spacing, TokenStream, TokenTree};

/// One name that a `use` brings.
pub(crate) struct Import {
    pub(crate) path: Vec<String>,
    /// What it is called here; `*` for everything in the path.
    pub(crate) name: String,
    pub(crate) is_public: bool,
}

/// A file that is being read, where its child modules lie, and its words that are left.
pub(crate) struct Reader<'a> {
    pub(crate) file: &'a Path,
    pub(crate) children: PathBuf,
    pub(crate) words: Peekable<IntoIter<String>>,
}

impl<'a> Reader<'a> {
    pub(crate) fn open(file: &'a Path, children: PathBuf) -> Self {
        let text = fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let tokens = text.parse::<TokenStream>();
        let tokens = tokens.unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let mut words = Vec::new();
        flatten(tokens, &mut words);
        Self {
            file,
            children,
            words: words.into_iter().peekable(),
        }
    }

    /// The next group, which may have others inside, as text.
    pub(crate) fn group(&mut self) -> String {
        let (mut depth, mut text) = (0, String::new());
        for word in self.words.by_ref() {
            depth += nesting(&word);
            text += &word;
            if depth == 0 && nesting(&word) < 0 {
                break;
            }
        }
        text
    }

    /// Leaves out what follows an attribute: to its `;`, to the end of its braces or of what it is in, and
    /// of fields and variants, which no keyword starts, to the comma.
    pub(crate) fn skip_item(&mut self) {
        let mut is_field = true;
        while let Some(next) = self.words.peek().cloned() {
            if nesting(&next) > 0 {
                self.group();
            } else if nesting(&next) == 0 {
                self.words.next();
            }
            let ends_field = is_field && next == ",";
            if nesting(&next) < 0 || next == "{" || next == ";" || ends_field {
                break;
            }
            is_field &= !["fn", "impl", "struct", "enum", "trait", "type"].contains(&&*next);
        }
    }

    /// The path that a name starts; what is in angle brackets ends it.
    pub(crate) fn path(&mut self, first: String) -> Vec<String> {
        let mut path = vec![first];
        while self.words.next_if(|word| word == "::").is_some() {
            match self.words.next_if(|word| is_name(word)) {
                Some(name) => path.push(name),
                None => break,
            }
        }
        path
    }

    /// The rest of a `use`, or a branch of one, below `prefix`.
    pub(crate) fn read_use(
        &mut self,
        prefix: &[String],
        is_public: bool,
        imports: &mut Vec<Import>,
    ) {
        let (mut path, mut name) = (prefix.to_vec(), None);
        while let Some(word) = self
            .words
            .next_if(|word| ![",", ";", "}"].contains(&word.as_str()))
        {
            match word.as_str() {
                "{" => {
                    while self.words.next_if(|word| word == "}").is_none() {
                        self.read_use(&path, is_public, imports);
                        self.words.next_if(|word| word == ",");
                    }
                    return;
                }
                "as" => name = self.words.next(),
                "*" => name = Some(word),
                "self" if !path.is_empty() => {}
                // Another crate's: nothing of ours has this name.
                "::" if path.is_empty() => path.push(word),
                "::" => {}
                _ => path.push(word),
            }
        }
        let last = path.last().cloned().unwrap_or_default();
        imports.push(Import {
            path,
            name: name.unwrap_or(last),
            is_public,
        });
    }
}

/// 1 where a group opens, -1 where it closes.
pub(crate) fn nesting(word: &str) -> i32 {
    match word {
        "{" | "(" | "[" => 1,
        "}" | ")" | "]" => -1,
        _ => 0,
    }
}

pub(crate) fn is_name(word: &str) -> bool {
    word.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

pub(crate) fn is_for_tests(attribute: &str) -> bool {
    attribute == "[test]"
        || (attribute.starts_with("[cfg(") && attribute.contains("test"))
            && !attribute.contains("not(test")
}

/// The words of a file one after another, without comments and literals.
fn flatten(tokens: TokenStream, words: &mut Vec<String>) {
    let mut colon = false;
    for token in tokens {
        let was_colon = std::mem::take(&mut colon);
        match token {
            TokenTree::Group(group) => {
                let (open, close) = match group.delimiter() {
                    Delimiter::Brace => ("{", "}"),
                    Delimiter::Bracket => ("[", "]"),
                    Delimiter::Parenthesis | Delimiter::None => ("(", ")"),
                };
                words.push(open.into());
                flatten(group.stream(), words);
                words.push(close.into());
            }
            TokenTree::Punct(punct) if punct.as_char() == ':' && was_colon => {
                words.pop();
                words.push("::".into());
            }
            TokenTree::Punct(punct) => {
                colon = punct.as_char() == ':' && punct.spacing() == Spacing::Joint;
                words.push(punct.as_char().to_string());
            }
            // A lifetime's name is no name of ours.
            TokenTree::Ident(_) if words.last().is_some_and(|word| word == "'") => {}
            TokenTree::Ident(name) => words.push(name.to_string()),
            TokenTree::Literal(_) => words.push("0".into()),
        }
    }
}
