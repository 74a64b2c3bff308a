//! What ARCHITECTURE.md promises about manifests and sources, checked.

use limpid_tests::skipped;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use toml::{Table, Value};

/// Every crate of the workspace and the crates of ours that it may depend on.
const ARROWS: [(&str, &[&str]); 15] = [
    ("property", &[]),
    ("host", &[]),
    ("signals", &[]),
    ("splat-core", &["host"]),
    ("motion-bases", &["host", "property"]),
    ("bpnet", &["host"]),
    ("capture", &["host"]),
    ("unseen-views", &["splat-core", "property"]),
    ("io", &["splat-core"]),
    (
        "trainer",
        &[
            "host",
            "splat-core",
            "motion-bases",
            "bpnet",
            "capture",
            "unseen-views",
            "io",
        ],
    ),
    ("limpid", &["io", "signals", "trainer"]),
    (
        "limpid-tests",
        &[
            "host",
            "splat-core",
            "motion-bases",
            "bpnet",
            "capture",
            "unseen-views",
            "io",
            "property",
            "trainer",
        ],
    ),
    (
        "limpid-bench",
        &["host", "splat-core", "bpnet", "io", "trainer"],
    ),
    ("limpid-lab", &["signals", "property"]),
    ("xtask", &[]),
];

/// Crates that know nothing of Burn, not even through another crate's feature.
const WITHOUT_BURN: [&str; 6] = [
    "unseen-views",
    "io",
    "property",
    "signals",
    "limpid-lab",
    "xtask",
];

/// Crates that neither touch files nor log nor look at a clock.
const SILENT: [&str; 5] = [
    "splat-core",
    "motion-bases",
    "bpnet",
    "capture",
    "unseen-views",
];

fn root() -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR"));
    tests.parent().expect("tests/ lies in the root").to_owned()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn manifest(folder: &Path) -> Table {
    let path = folder.join("Cargo.toml");
    read(&path)
        .parse()
        .unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// The folders of all members, by package name.
fn members() -> BTreeMap<String, PathBuf> {
    let root = root();
    let mut folders: Vec<PathBuf> = fs::read_dir(root.join("crates"))
        .expect("crates/ can be read")
        .map(|entry| entry.expect("an entry of crates/").path())
        .filter(|path| path.is_dir())
        .collect();
    folders.extend(["bench", "lab", "tests", "xtask"].map(|folder| root.join(folder)));
    folders
        .into_iter()
        .map(|folder| {
            let name = manifest(&folder)["package"]["name"]
                .as_str()
                .map(str::to_owned);
            (name.expect("a package has a name"), folder)
        })
        .collect()
}

/// All dependencies of a manifest: normal, dev, build, and those of one platform.
fn dependencies(manifest: &Table) -> Vec<(String, Value)> {
    let mut tables = vec![manifest];
    if let Some(Value::Table(targets)) = manifest.get("target") {
        tables.extend(targets.values().filter_map(Value::as_table));
    }
    let kinds = ["dependencies", "dev-dependencies", "build-dependencies"];
    tables
        .into_iter()
        .flat_map(|table| kinds.iter().filter_map(|&kind| table.get(kind)?.as_table()))
        .flat_map(|table| {
            table
                .iter()
                .map(|(name, value)| (name.clone(), value.clone()))
        })
        .collect()
}

fn features(dependency: &Value) -> Vec<&str> {
    dependency
        .get("features")
        .and_then(Value::as_array)
        .map_or_else(Vec::new, |f| f.iter().filter_map(Value::as_str).collect())
}

#[test]
fn arrows_between_crates_are_those_of_the_design() {
    let members = members();
    let names: Vec<&str> = members.keys().map(String::as_str).collect();
    let mut known: Vec<&str> = ARROWS.iter().map(|(name, _)| *name).collect();
    known.sort_unstable();
    assert_eq!(names, known, "a new crate needs a row in ARROWS");

    for (name, allowed) in ARROWS {
        for (dependency, value) in dependencies(&manifest(&members[name])) {
            let ours = names.contains(&dependency.as_str());
            assert!(
                !ours || allowed.contains(&dependency.as_str()),
                "{name} must not depend on {dependency}"
            );
            assert_eq!(
                value.get("workspace").and_then(Value::as_bool),
                Some(true),
                "{name}: {dependency} takes its version from the workspace"
            );
            if WITHOUT_BURN.contains(&name) {
                assert!(
                    !dependency.starts_with("burn") && !dependency.starts_with("cubecl"),
                    "{name} must not depend on {dependency}"
                );
                assert!(
                    !ours || features(&value).is_empty(),
                    "{name} takes {dependency} without features"
                );
            }
        }
    }
    let xtask = dependencies(&manifest(&members["xtask"]));
    assert!(xtask.is_empty(), "xtask has dependencies: {xtask:?}");

    let workspace = manifest(&root());
    let splat_core = &workspace["workspace"]["dependencies"]["splat-core"];
    assert_eq!(
        splat_core.get("default-features").and_then(Value::as_bool),
        Some(false),
        "splat-core's default feature is Burn: those who want it ask for it"
    );
}

#[test]
fn members_share_lints_edition_and_licence() {
    for (name, folder) in members() {
        let manifest = manifest(&folder);
        let shared = |table: &str, key: &str| {
            let value = manifest.get(table).and_then(|t| t.get(key));
            value.is_some_and(|v| {
                v.as_bool() == Some(true)
                    || v.get("workspace").and_then(Value::as_bool) == Some(true)
            })
        };
        for (table, key) in [
            ("lints", "workspace"),
            ("package", "edition"),
            ("package", "rust-version"),
            ("package", "license"),
            ("package", "version"),
        ] {
            assert!(
                shared(table, key),
                "{name}: [{table}] {key} is not the workspace's"
            );
        }
    }
}

#[test]
fn burn_is_pinned_and_its_default_features_are_off() {
    let workspace = manifest(&root());
    let shared = workspace["workspace"]["dependencies"]
        .as_table()
        .expect("a table of dependencies");
    assert_eq!(
        shared["burn"].get("version").and_then(Value::as_str),
        Some("=0.22.1"),
        "burn's version"
    );
    let mut all: Vec<(String, Value)> = shared.clone().into_iter().collect();
    for folder in members().values() {
        all.extend(dependencies(&manifest(folder)));
    }
    for (name, value) in all {
        if !name.starts_with("burn") && !name.starts_with("cubecl") {
            continue;
        }
        assert!(
            value.get("workspace").is_some()
                || value.get("default-features").and_then(Value::as_bool) == Some(false),
            "{name}: default features bring fusion and autotune"
        );
        for feature in features(&value) {
            assert!(
                !["default", "fusion", "autotune"].contains(&feature),
                "{name} must not have the feature {feature}"
            );
        }
    }
}

#[test]
fn no_crate_turns_fusion_or_autotune_on() {
    // Features unite over the whole workspace, so that one careless dependency would do it for all.
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    for (backend, crate_of_its) in [("flex", "burn-flex v"), ("wgpu", "burn-wgpu v")] {
        let output = Command::new(&cargo)
            .args(["tree", "--workspace", "--offline", "--edges", "features"])
            .args(["--prefix", "none", "--features"])
            .arg(format!("limpid/{backend}"))
            .current_dir(root())
            .output()
            .expect("cargo runs");
        let said = String::from_utf8_lossy(&output.stderr);
        // A machine that has never built for a GPU has none of its crates, and need not fetch them for this.
        if backend == "wgpu" && said.contains("--offline was specified") {
            let why = "the crates of wgpu were never downloaded here";
            skipped("no_crate_turns_fusion_or_autotune_on", why);
            continue;
        }
        assert!(output.status.success(), "cargo tree: {said}");
        let tree = String::from_utf8_lossy(&output.stdout);
        assert!(tree.contains(crate_of_its), "no {crate_of_its} in the tree");
        for line in tree.lines() {
            let family = line.starts_with("burn") || line.starts_with("cubecl");
            for feature in ["feature \"fusion\"", "feature \"autotune\""] {
                assert!(!(family && line.contains(feature)), "turned on: {line}");
            }
        }
    }
}

#[test]
fn running_and_testing_share_one_build_of_burn() {
    // Lines such as "rayon v1.12.0 default", for packages that Burn is compiled with.
    let tree = |args: &[&str]| -> BTreeSet<String> {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        let output = Command::new(cargo)
            .args(["tree", "--offline", "--prefix", "none"])
            .args(args)
            .current_dir(root())
            .output()
            .expect("cargo runs");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success(), "cargo tree {args:?}");
        let lines = text.lines().map(|line| line.trim_end_matches(" (*)"));
        lines.map(str::to_owned).collect()
    };
    let name = |line: &String| -> String { line.split(' ').take(2).collect::<Vec<_>>().join(" ") };
    let below: BTreeSet<String> = tree(&["--package", "burn", "--edges", "normal,build"])
        .iter()
        .map(name)
        .collect();
    let features = |args: &[&str]| -> BTreeSet<String> {
        let lines = tree(&[args, &["--format", "{p} {f}"]].concat()).into_iter();
        lines.filter(|line| below.contains(&name(line))).collect()
    };
    let all = "normal,build,dev";
    assert_eq!(
        features(&["--package", "limpid", "--edges", "normal,build"]),
        features(&["--workspace", "--edges", all]),
        "features of crates below Burn: cargo run and cargo test would each compile it"
    );
}

/// All files below `folder` that are text of ours, in order.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder)
        .unwrap_or_else(|e| panic!("{}: {e}", folder.display()))
        .map(|entry| entry.expect("an entry of a folder").path())
        .collect();
    entries.sort();
    let mut found = Vec::new();
    for path in entries {
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path
            .extension()
            .is_some_and(|e| ["rs", "toml", "md"].iter().any(|known| e == *known))
        {
            found.push(path);
        }
    }
    found
}

#[test]
fn sources_are_finished_and_name_no_machine() {
    let root = root();
    // Not fuzz/ whole: cargo builds in it.
    let mut files: Vec<PathBuf> = [
        "bench",
        "crates",
        "lab",
        "tests",
        "xtask",
        ".cargo",
        "fuzz/src",
        "fuzz/fuzz_targets",
    ]
    .iter()
    .flat_map(|folder| sources(&root.join(folder)))
    .collect();
    files.push(root.join("fuzz/Cargo.toml"));
    files.push(root.join(".ci/run"));
    for name in ["Cargo.toml", "README.md", "ARCHITECTURE.md", "CHANGELOG.md"] {
        files.push(root.join(name));
    }
    for optional in ["RESULTS.md", "demo/limpid.toml"].map(|name| root.join(name)) {
        files.extend(optional.exists().then_some(optional));
    }
    // In two parts, so that this file does not hold them.
    let unfinished = [["#[", "ignore"], ["todo", "!("], ["unimplemented", "!("]];
    let machine = [["/wo", "rk/"], ["/ro", "ot/"], ["/ho", "me/"]];
    for file in files {
        let text = read(&file);
        let is_rust = file.extension().is_some_and(|e| e == "rs");
        let unfinished = unfinished.iter().filter(|_| is_rust);
        for pattern in unfinished.chain(&machine).map(|parts| parts.concat()) {
            let line = text.lines().position(|line| line.contains(&pattern));
            assert!(
                line.is_none(),
                "{}:{} has {pattern}",
                file.display(),
                line.unwrap_or(0) + 1
            );
        }
    }
}

#[test]
fn libraries_touch_neither_files_nor_clock_nor_terminal() {
    let members = members();
    let absent = [
        "std::fs",
        "std::io",
        "std::env",
        "std::process",
        "Instant",
        "SystemTime",
        "println!",
        "eprint!",
        "rand::rng()",
        "from_os_rng",
    ];
    for name in SILENT {
        for file in sources(&members[name].join("src")) {
            let text = read(&file);
            for pattern in absent {
                assert!(!text.contains(pattern), "{} has {pattern}", file.display());
            }
        }
    }
}

#[test]
fn the_architecture_names_every_crate() {
    let root = root();
    let architecture = read(&root.join("ARCHITECTURE.md"));
    for folder in members().values() {
        let path = folder.strip_prefix(&root).expect("below the root");
        let named = format!("`{}/`", path.display());
        assert!(
            architecture.contains(&named),
            "ARCHITECTURE.md does not name {named}"
        );
    }
}
