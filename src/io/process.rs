//! Resources of this process, and the identity of the present boot.

/// Resident memory in megabytes; `None` where /proc does not provide it.
pub fn resident_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kb: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kb * 1024.0 / 1e6)
}

/// Lowers the priority of the calling thread by this number of steps (19 at most). Without effect where the system does
/// not allow it.
pub fn be_nice(steps: i32) {
    // On Linux it is the thread's own.
    let _ = rustix::process::nice(steps);
}

/// The kernel's identity of this boot; `None` where /proc does not provide it.
pub fn boot_id() -> Option<String> {
    let id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    Some(id.trim().to_owned()).filter(|id| !id.is_empty())
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_process_has_memory() {
        let mb = super::resident_mb().expect("from /proc");
        assert!((0.5..100_000.0).contains(&mb), "{mb}");
    }

    #[test]
    fn a_boot_keeps_its_name() {
        let id = super::boot_id().expect("from /proc");
        assert_eq!(super::boot_id().as_deref(), Some(id.as_str()));
    }
}
