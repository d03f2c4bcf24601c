//! The unit in the judgement of systemd itself.

use std::process::Command;

use crate::leave_out::leave_out;

/// The unit file.
const UNIT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/systemd/windhover.service");

/// Highest exposure accepted: 1.5, which `systemd-analyze` writes as 15.
const EXPOSURE: &str = "--threshold=15";

#[test]
fn the_unit_exposes_little() {
    let run = Command::new("systemd-analyze").args(["security", "--offline=true", EXPOSURE, UNIT]).output();
    let Ok(output) = run else {
        leave_out("the unit", "systemd-analyze is not installed");
        return;
    };
    let report = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{report}\n{}", String::from_utf8_lossy(&output.stderr));
    assert!(report.contains("Overall exposure level"), "{report}");
}

#[test]
fn the_unit_watches_and_restarts() {
    let unit = std::fs::read_to_string(UNIT).expect("the unit");
    for setting in [
        "Type=notify",
        "WatchdogSec=",
        "Restart=always",
        "RestartPreventExitStatus=78",
        "ReadWritePaths=-/var/lib/windhover",
        "DeviceAllow=char-video4linux rw",
        "ExecReload=/bin/sh -c \"kill -HUP $MAINPID\"",
        "ProtectSystem=strict",
    ] {
        assert!(unit.lines().any(|line| line.starts_with(setting)), "{setting}");
    }
    // It would require the data card's mount, and no card would mean no flight.
    assert!(!unit.lines().any(|line| line.starts_with("StateDirectory=")));
    // Stopping takes under two seconds by itself; the service manager must not cut it short.
    let stop = unit.lines().find_map(|line| line.strip_prefix("TimeoutStopSec="));
    assert_eq!(stop, Some("5s"));
}

#[test]
fn the_cards_units_are_what_systemd_takes() {
    for unit in ["var-lib-windhover.mount", "windhover-card.service"] {
        let path = format!("{}/systemd/card/{unit}", env!("CARGO_MANIFEST_DIR"));
        let run = Command::new("systemd-analyze").args(["verify", "--man=no", &path]).output();
        let Ok(output) = run else {
            leave_out("the unit", "systemd-analyze is not installed");
            return;
        };
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success() && !said.contains(unit), "{said}");
    }
}
