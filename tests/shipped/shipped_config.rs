//! The shipped configuration explains every key and shows true defaults.

use windhover::config::Config;
use windhover_base::geo::LensModel;

fn shipped() -> String {
    std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/config/windhover.toml")).unwrap()
}

/// The file with every default that is shown after `#` made active.
fn with_defaults_spelt_out(text: &str) -> String {
    let is_default = |line: &str| {
        line.strip_prefix('#').is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_lowercase()))
    };
    text.lines().map(|line| if is_default(line) { &line[1..] } else { line }).collect::<Vec<_>>().join("\n")
}

#[test]
fn it_is_valid_and_its_defaults_are_the_programs() {
    let text = shipped();
    let as_shipped = Config::parse(&text).unwrap();
    let spelt_out = Config::parse(&with_defaults_spelt_out(&text)).unwrap();
    assert_eq!(as_shipped.to_toml().unwrap(), spelt_out.to_toml().unwrap());
}

#[test]
fn every_key_is_there() {
    let text = shipped();
    let effective = Config::parse(&text).unwrap().to_toml().unwrap();
    for line in effective.lines() {
        let Some((key, _)) = line.split_once(" = ") else { continue };
        let mentioned =
            text.lines().any(|l| l.trim_start_matches(['#', ' ']).starts_with(&format!("{key} =")));
        assert!(mentioned, "{key} is not explained in config/windhover.toml");
    }
}

#[test]
fn a_fisheye_has_four_terms() {
    let line = "distortion = [-0.17892, 0.13875, -0.00128, 0.0056, 0.0]";
    let with = |terms: &str| {
        let text = shipped().replace("#model = \"brown\"", "model = \"fisheye\"");
        Config::parse(&text.replace(line, &format!("distortion = {terms}")))
    };
    let lens = with("[-0.01, 0.002, 0.0, 0.001]").unwrap().camera.intrinsics;
    assert_eq!((lens.model, lens.distortion), (LensModel::Fisheye, [-0.01, 0.002, 0.0, 0.001, 0.0]));
    for terms in ["[-0.01, 0.002, 0.0, 0.001, 0.1]", "[-0.01, 0.002]"] {
        let error = with(terms).unwrap_err().to_string();
        assert!(error.contains("line") && error.contains("distortion"), "{terms}: {error}");
    }
}

#[test]
fn unknown_and_absurd_values_are_reported_by_name() {
    let text = shipped().replace("[gps]", "[gps]\ntypo = 1");
    let error = Config::parse(&text).unwrap_err().to_string();
    assert!(error.contains("typo") && error.contains("line"), "{error}");
    let text = shipped().replace("fx = 1019", "fx = -1019");
    let error = Config::parse(&text).unwrap_err().to_string();
    assert!(error.contains("camera.intrinsics.fx"), "{error}");
}
