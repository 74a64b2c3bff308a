//! Writes docs/NUMERICS.md: `cargo xtask numerics`.

use limpid_tests::numerics::{Place, cases, measure, measures, report};
use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    let rows: Vec<_> = cases()
        .iter()
        .map(|case| measure(case, &Place::F32))
        .collect();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent();
    let path = root
        .expect("tests/ lies in the root")
        .join("docs/NUMERICS.md");
    let text = report(&rows, &measures());
    if let Err(error) =
        std::fs::create_dir_all(path.with_file_name("")).and_then(|()| std::fs::write(&path, text))
    {
        eprintln!("numerics: cannot write {}: {error}", path.display());
        return ExitCode::FAILURE;
    }
    for row in rows {
        let worst = row.forward.of_promise.max(row.backward.of_promise);
        if worst > 1.0 {
            eprintln!(
                "numerics: {}, {}: {worst:.1} times what is promised",
                row.op, row.name
            );
        }
    }
    eprintln!("numerics: written to {}", path.display());
    ExitCode::SUCCESS
}
