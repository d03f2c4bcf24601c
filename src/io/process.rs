//! What this process costs the computer.

/// Resident memory in megabytes; `None` where /proc does not tell.
pub fn resident_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kb: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kb * 1024.0 / 1e6)
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_process_has_memory() {
        let mb = super::resident_mb().expect("told by /proc");
        assert!((0.5..100_000.0).contains(&mb), "{mb}");
    }
}
