//! Direction of dependence: a module names only modules above it in `lib.rs` (Cargo ensures it among the crates), and
//! core neither reads clocks nor logs nor touches devices.

use std::path::{Path, PathBuf};

/// Modules in the order of `lib.rs`, and how many of them are core.
fn modules() -> (Vec<String>, usize) {
    let text = std::fs::read_to_string(root().join("lib.rs")).unwrap();
    let (core, edge) = text.split_once("// -- edge").expect("lib.rs marks where the edge begins");
    let names = |text: &str| -> Vec<String> {
        text.lines().filter_map(|l| l.strip_prefix("pub mod ")?.strip_suffix(';')).map(String::from).collect()
    };
    let core = names(core);
    let count = core.len();
    (core.into_iter().chain(names(edge)).collect(), count)
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("src")
}

/// The source folders of the crates; all of them are core.
fn crates() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates");
    let entries = std::fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().path().join("src")).collect()
}

/// Every source file of a module, without its test modules' lines.
fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// The code of a file before its tests, without comments.
fn code(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap();
    let before_tests = text.split("#[cfg(test)]").next().unwrap_or("");
    before_tests.lines().filter(|l| !l.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

fn is_test_file(path: &Path) -> bool {
    path.file_stem().is_some_and(|s| s.to_string_lossy().ends_with("tests"))
        || path.components().any(|c| c.as_os_str() == "tests")
}

#[test]
fn modules_name_only_what_stands_above_them() {
    let (modules, _) = modules();
    assert!(modules.len() > 5, "lib.rs was not understood: {modules:?}");
    let mut wrong = Vec::new();
    for (place, module) in modules.iter().enumerate() {
        let mut files = Vec::new();
        sources(&root().join(module), &mut files);
        for file in files.iter().filter(|f| !is_test_file(f)) {
            let code = code(file);
            for below in &modules[place + 1..] {
                if code.contains(&format!("crate::{below}::")) || code.contains(&format!("crate::{below};")) {
                    wrong.push(format!("{} names {below}", file.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// `io` moves events and records: it does not decode, detect or estimate. From `windhover_decode` it uses only the
/// framing of sentences and packets, because receivers are configured with them, and because valid ones indicate the
/// right line speed.
#[test]
fn io_names_no_stage() {
    let stages = [
        "crate::pipeline",
        "windhover_detect",
        "windhover_estimate",
        "windhover_calibrate",
        "windhover_refine",
        "windhover_simulate",
        "GnssDecoder",
        "CompassDecoder",
    ];
    let mut files = Vec::new();
    sources(&root().join("io"), &mut files);
    assert!(files.len() > 50, "the sources of io were not found");
    let named = |file: &PathBuf| {
        let code = code(file);
        let found = stages.into_iter().filter(|stage| code.contains(stage));
        found.map(|stage| format!("{} names {stage}", file.display())).collect::<Vec<_>>()
    };
    let wrong: Vec<String> = files.iter().filter(|f| !is_test_file(f)).flat_map(named).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn core_computes_and_nothing_else() {
    let (modules, core) = modules();
    assert!(crates().len() > 5, "the crates were not found");
    let forbidden = [
        "std::fs::",
        "TcpStream",
        "UdpSocket",
        "std::thread::sleep",
        "Instant::now",
        "SystemTime::now",
        "tracing::",
        "tokio::",
        "println!",
        "eprintln!",
        "std::env::",
    ];
    let mut wrong = Vec::new();
    let folders = modules[..core].iter().map(|module| root().join(module)).chain(crates());
    for folder in folders {
        let mut files = Vec::new();
        sources(&folder, &mut files);
        assert!(!files.is_empty(), "{} holds no sources", folder.display());
        for file in files.iter().filter(|f| !is_test_file(f)) {
            let code = code(file);
            let found = forbidden.iter().filter(|word| code.contains(**word));
            wrong.extend(found.map(|word| format!("{} uses {word}", file.display())));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
