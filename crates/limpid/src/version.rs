//! What `limpid --version` says.

use std::sync::LazyLock;

/// The version, the commit that it was built from, and the backends that are in it.
pub(crate) fn long() -> &'static str {
    static LONG: LazyLock<String> = LazyLock::new(|| {
        let backends = [
            ("flex", cfg!(feature = "flex")),
            ("ndarray", cfg!(feature = "ndarray")),
            ("wgpu", cfg!(feature = "wgpu")),
            ("cuda", cfg!(feature = "cuda")),
        ];
        let backends = backends.iter().filter(|(_, is_in)| *is_in);
        let backends: Vec<&str> = backends.map(|(name, _)| *name).collect();
        format!(
            "{} (commit {}; backends: {})",
            env!("CARGO_PKG_VERSION"),
            env!("LIMPID_COMMIT"),
            backends.join(", ")
        )
    });
    &LONG
}
