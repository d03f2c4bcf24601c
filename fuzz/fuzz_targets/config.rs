//! Arbitrary text as a configuration: no panic, and an accepted configuration can be written and accepted again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use windhover::config::Config;

/// The shipped configuration, whose lines the fuzzer replaces.
const SHIPPED: &str = include_str!("../../config/windhover.toml");

fuzz_target!(|data: &[u8]| {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let _ = Config::parse(text);
    // The first byte selects a line of the shipped configuration, which the rest replaces.
    let Some((&line, _)) = data.split_first() else { return };
    let mut lines: Vec<&str> = SHIPPED.lines().filter(|l| !l.starts_with('#') && !l.is_empty()).collect();
    let at = usize::from(line) % lines.len();
    lines[at] = text.get(1..).unwrap_or_default();
    if let Ok(config) = Config::parse(&lines.join("\n")) {
        let written = config.to_toml().expect("what was accepted can be written");
        assert!(Config::parse(&written).is_ok_and(|again| again == config));
    }
});
