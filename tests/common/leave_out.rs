//! A test that cannot run on this machine reports that, and the checks list it at their end.

use std::io::Write;

/// The list that `.ci/run` shows at its end.
const LEFT_OUT: &str = concat!(env!("CARGO_TARGET_TMPDIR"), "/skipped");

/// Reports that a test is left out, and why.
pub fn leave_out(test: &str, why: &str) {
    println!("SKIPPED {test}: {why}");
    let file = std::fs::OpenOptions::new().create(true).append(true).open(LEFT_OUT);
    file.and_then(|mut file| writeln!(file, "SKIPPED {test}: {why}")).unwrap();
}
