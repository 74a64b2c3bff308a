#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use limpid_fuzz::parsers::scenes;

static SCENES: LazyLock<PathBuf> = LazyLock::new(|| scenes().keep());

fuzz_target!(|bytes: &[u8]| {
    limpid_fuzz::parsers::exr(&SCENES, bytes).ok();
});
