//! No circle among the source files of a crate: what a file uses never leads back to it, so that each can be
//! read, tested and moved with what lies below it alone.
//!
//! Uses are read from the words of a file: `use` declarations, and the paths and names in the rest. A
//! re-export is followed to the file that defines the thing: a front page that re-exports its own modules
//! uses none of them, and whoever takes a name from it uses what lies behind. What only the compiler can
//! tell (methods, what macros make) is not seen. Code for tests alone does not count.

mod reader;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use reader::{Import, Reader, is_for_tests, is_name, nesting};

/// A module, in a file of its own or within its parent's.
#[derive(Default)]
struct Module {
    file: PathBuf,
    /// What it defines: functions, types, constants, macros.
    items: BTreeSet<String>,
    imports: Vec<Import>,
    /// Paths, and names alone, anywhere but in `use`.
    paths: BTreeSet<Vec<String>>,
}

/// The modules of a crate by their paths, such as `crate::cpu::raster`.
struct Crate(BTreeMap<String, Module>);

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Module,
    Item,
}

/// What a path leads to.
enum Target {
    Module(String),
    /// What a module defines.
    Item(String, String),
}

impl Crate {
    fn read(root: &Path) -> Self {
        let mut modules = Self(BTreeMap::new());
        let folder = root.parent().expect("a file lies in a folder");
        modules.read_file("crate".into(), root, folder.to_owned());
        modules
    }

    fn read_file(&mut self, module: String, file: &Path, children: PathBuf) {
        let mut reader = Reader::open(file, children);
        self.read_module(module, &mut reader);
    }

    /// Reads up to the brace that closes the module.
    fn read_module(&mut self, module: String, reader: &mut Reader<'_>) {
        let mut found = Module {
            file: reader.file.to_owned(),
            ..Module::default()
        };
        let (mut depth, mut before) = (0, String::new());
        while let Some(word) = reader.words.next() {
            depth += nesting(&word);
            if depth < 0 {
                break;
            }
            let next = reader.words.peek().cloned().unwrap_or_default();
            match word.as_str() {
                "#" if next == "[" || next == "!" => {
                    let attribute = reader.group();
                    if is_for_tests(&attribute) {
                        reader.skip_item();
                    }
                }
                "use" if next != "<" => {
                    let is_public = before == "pub" || before == ")";
                    reader.read_use(&[], is_public, &mut found.imports);
                }
                "mod" if depth == 0 => {
                    reader.words.next();
                    let child = format!("{module}::{next}");
                    let children = reader.children.join(&next);
                    if reader.words.next().as_deref() == Some("{") {
                        let parent = std::mem::replace(&mut reader.children, children);
                        self.read_module(child, reader);
                        reader.children = parent;
                    } else {
                        let flat = children.with_extension("rs");
                        let nested = children.join("mod.rs");
                        let file = if flat.is_file() { flat } else { nested };
                        self.read_file(child, &file, children);
                    }
                }
                "fn" | "struct" | "enum" | "union" | "trait" | "type" | "const" | "static"
                    if depth == 0 =>
                {
                    found.items.insert(next);
                }
                "macro_rules" => {
                    reader.words.next();
                    found.items.extend(reader.words.next());
                }
                // Neither fields and methods, nor other crates' `::name`.
                name if is_name(name) && before != "." && before != "::" => {
                    let path = reader.path(word.clone());
                    // `name:` is a field or an argument.
                    if path.len() > 1 || reader.words.peek().is_none_or(|next| next != ":") {
                        found.paths.insert(path);
                    }
                }
                _ => {}
            }
            before = word;
        }
        self.0.insert(module, found);
    }

    /// What `path` means in a module. A name may be a module's and an item's at once: its last one is the
    /// item's, unless it is the module that is wanted. `fuel` ends where imports import each other.
    fn resolve(&self, module: &str, path: &[String], wanted: Kind, fuel: usize) -> Option<Target> {
        let mut target = Target::Module(module.to_owned());
        for (at, name) in path.iter().enumerate() {
            let Target::Module(inside) = &target else {
                break;
            };
            let is_last = at + 1 == path.len();
            let kind = if is_last { wanted } else { Kind::Module };
            target = match name.as_str() {
                "crate" => Target::Module("crate".into()),
                "self" => continue,
                "super" => Target::Module(inside.rsplit_once("::")?.0.into()),
                name => self.look_up(inside, name, kind, fuel)?,
            };
        }
        Some(target)
    }

    fn look_up(&self, module: &str, name: &str, wanted: Kind, fuel: usize) -> Option<Target> {
        let (child, found) = (format!("{module}::{name}"), self.0.get(module)?);
        let child = self.0.contains_key(&child).then_some(Target::Module(child));
        if child.is_some() && wanted == Kind::Module {
            return child;
        }
        if found.items.contains(name) {
            return Some(Target::Item(module.into(), name.into()));
        }
        let fuel = fuel.checked_sub(1)?;
        let imported = found.imports.iter().find_map(|import| {
            if import.name == name {
                return self.resolve(module, &import.path, wanted, fuel);
            }
            let all = (import.name == "*")
                .then(|| self.resolve(module, &import.path, Kind::Module, fuel));
            match all.flatten()? {
                Target::Module(all) => self.look_up(&all, name, wanted, fuel),
                Target::Item(..) => None,
            }
        });
        imported.or(child)
    }

    /// The files that each file uses, with the names that it takes from them.
    fn uses(&self) -> BTreeMap<&Path, BTreeMap<&Path, BTreeSet<String>>> {
        const FUEL: usize = 8;
        let mut uses = BTreeMap::<_, BTreeMap<_, BTreeSet<_>>>::new();
        for (module, found) in &self.0 {
            // A module that re-exports its own children does not use them.
            let imports = found.imports.iter().map(|i| (&i.path, i.is_public));
            let paths = found.paths.iter().map(|path| (path, false));
            for (path, is_public) in imports.chain(paths) {
                if let Some(Target::Item(of, name)) = self.resolve(module, path, Kind::Item, FUEL) {
                    let file = self.0[&of].file.as_path();
                    let is_below = of.starts_with(&format!("{module}::"));
                    if file != found.file && !(is_public && is_below) {
                        let names = uses.entry(found.file.as_path()).or_default();
                        names.entry(file).or_default().insert(name);
                    }
                }
            }
        }
        uses
    }

    /// The shortest circle through each file that is on one, every circle once; files are named as seen
    /// from `folder`.
    fn circles(&self, folder: &Path) -> Vec<String> {
        let name = |file: &Path| {
            file.strip_prefix(folder)
                .unwrap_or(file)
                .display()
                .to_string()
        };
        let uses = self.uses();
        let (mut seen, mut circles) = (BTreeSet::new(), Vec::new());
        for &start in uses.keys() {
            // Who was the first to use a file, of those that `start` leads to.
            let mut user = BTreeMap::<&Path, &Path>::new();
            let mut files = vec![start];
            while !files.is_empty() && !user.contains_key(start) {
                let mut next = Vec::new();
                for file in files {
                    for &used in uses.get(file).into_iter().flat_map(BTreeMap::keys) {
                        user.entry(used).or_insert_with(|| {
                            next.push(used);
                            file
                        });
                    }
                }
                files = next;
            }
            let Some(mut file) = user.get(start).copied() else {
                continue;
            };
            let mut circle = vec![start];
            while file != start {
                circle.push(file);
                file = user[file];
            }
            circle.push(start);
            circle.reverse();
            if seen.insert(BTreeSet::from_iter(circle.clone())) {
                let steps = circle.windows(2).map(|pair| {
                    let names = Vec::from_iter(uses[pair[0]][pair[1]].iter().cloned());
                    format!(" uses {} of {}", names.join(", "), name(pair[1]))
                });
                circles.push(name(start) + &String::from_iter(steps));
            }
        }
        circles
    }
}

/// The files below `src` that are compiled by themselves: a library and programs.
fn roots(source: &Path) -> Vec<PathBuf> {
    let mut roots = vec![source.join("lib.rs"), source.join("main.rs")];
    for entry in fs::read_dir(source.join("bin")).into_iter().flatten() {
        let path = entry.expect("an entry of a folder").path();
        roots.extend([path.join("main.rs"), path]);
    }
    roots.retain(|path| path.is_file());
    roots
}

#[test]
fn no_circle_among_source_files() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = folder.parent().expect("tests/ lies in the root");
    let crates = fs::read_dir(folder.join("crates")).expect("crates/ can be read");
    let crates = crates.map(|entry| entry.expect("an entry of a folder").path());
    let others = ["bench", "fuzz", "lab", "tests", "xtask"].map(|name| folder.join(name));
    let (mut files, mut circles) = (0, Vec::new());
    for source in crates.chain(others).map(|folder| folder.join("src")) {
        for root in roots(&source) {
            let modules = Crate::read(&root);
            files += modules.0.len();
            circles.extend(modules.circles(folder));
        }
    }
    assert!(files > 50, "only {files} modules were found");
    circles.sort();
    assert!(circles.is_empty(), "circles:\n{}", circles.join("\n"));
}

/// The circles in a crate of these files, without the folder's name.
fn circles(files: &[(&str, &str)]) -> Vec<String> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for (name, text) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder can be made");
        fs::write(path, text).expect("a file can be written");
    }
    Crate::read(&folder.path().join("lib.rs")).circles(folder.path())
}

#[test]
fn a_planted_circle_is_named() {
    // Through a front page, a name in a path, a module's name, and everything of a module.
    for c in [
        "use crate::A; pub fn c() -> A { A(panic!()) }",
        "pub fn c<T: Fn() -> crate::a::A>() {}",
        "use super::a; pub fn c() -> [a::A; 1] { panic!() }",
        "use crate::*; pub fn c() { println!(\"{:?}\", A) }",
        "pub fn c() { use super::{a::{self as first}}; first::A.f() }",
    ] {
        let files = [
            ("lib.rs", "mod a; mod b; mod c; pub use a::A; pub use c::*;"),
            ("a.rs", "use crate::b::B; pub struct A(B);"),
            ("b.rs", "pub struct B; impl B { fn b() { super::c::c() } }"),
            ("c.rs", c),
        ];
        let found = circles(&files);
        let [circle] = &found[..] else {
            panic!("{c}: {found:?}");
        };
        for part in [
            "a.rs uses B of b.rs",
            "b.rs uses c of c.rs",
            "c.rs uses A of a.rs",
        ] {
            assert!(circle.contains(part), "{c}: {circle}");
        }
    }
}

#[test]
fn a_parent_and_its_child_are_a_circle_when_each_uses_the_other() {
    let child = (
        "a/child.rs",
        "use super::Shared; pub fn child(_: Shared) {}",
    );
    for (parent, is_circle) in [
        (
            "mod child; pub struct Shared; fn f() { child::child(Shared) }",
            true,
        ),
        (
            "mod child; pub use child::child; pub struct Shared; fn f() { child(Shared) }",
            true,
        ),
        (
            "mod child; use self::child::child; pub struct Shared; const F: fn() = child;",
            true,
        ),
        // A parent that names its child, or hands out what it has, does not use it.
        ("mod child; pub use child::child; pub struct Shared;", false),
        ("mod child { } pub(crate) mod b; pub struct Shared;", false),
        // What the parent has from elsewhere is not the parent's.
        (
            "mod child; pub mod b; use b::Shared; fn f(s: Shared) { child::child(s) }",
            false,
        ),
    ] {
        let files = [
            ("lib.rs", "mod a;"),
            ("a/mod.rs", parent),
            child,
            ("a/b.rs", "pub struct Shared;"),
        ];
        let found = circles(&files);
        assert_eq!(!found.is_empty(), is_circle, "{parent}: {found:?}");
    }
}

#[test]
fn tests_comments_texts_and_other_crates_are_no_uses() {
    let b = r#"
        //! See [`crate::a::A`].
        #![allow(unused)]
        use ::a::A; use std::path as a;
        pub struct B<'a> { a: &'a str, #[cfg(test)] of: crate::a::A, }
        pub fn b<'a>(a: B<'a>) -> &'a str { /* crate::a::A */ a.a; "crate::a::A" }
        #[cfg(test)] use crate::a::{A, A as C};
        #[cfg(all(test, feature = "x"))] fn c<T, U>(_: crate::a::A) -> crate::a::A { crate::a::A }
        #[cfg(test)] mod tests { use crate::a::A; }
        #[cfg(test)] #[path = "nowhere.rs"] mod elsewhere;
    "#;
    let files = [
        ("lib.rs", "mod a; mod b;"),
        ("a.rs", "use crate::b::B; pub struct A(B<'static>);"),
        ("b.rs", b),
    ];
    assert_eq!(circles(&files), Vec::<String>::new());
    // The same without the conditions is a circle.
    let b = b.replace("#[cfg(test)]", "");
    let files = [
        files[0],
        files[1],
        ("b.rs", &b[..b.find("#[path").expect("the last line")]),
    ];
    assert_eq!(circles(&files).len(), 1, "uses that are not for tests");
}
