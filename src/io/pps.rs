//! Pulse per second: the kernel's stamps of a receiver's pulse (Linux `/dev/ppsN`, RFC 2783).

use std::convert::Infallible;
use std::fs::File;
use std::io;
use std::os::fd::AsFd;
use std::time::Duration;

use rustix::ioctl::{Ioctl, IoctlOutput, Opcode, ioctl, opcode};
use tokio::io::Interest;

use super::clock::HostClock;
use super::device::{Fault, FaultKind, Report, Reports, register, wait_for, watch_line};
use windhover_base::time::MonoTime;

/// `struct pps_ktime` of linux/pps.h.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct PpsTime {
    sec: i64,
    nsec: i32,
    flags: u32,
}

/// `struct pps_fdata` of linux/pps.h: its `pps_kinfo`, then the time-out.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct PpsFetch {
    assert_sequence: u32,
    clear_sequence: u32,
    assert: PpsTime,
    clear: PpsTime,
    current_mode: i32,
    timeout: PpsTime,
}

/// `PPS_FETCH`, `_IOWR('p', 0xa4, struct pps_fdata *)`: the header uses the size of a pointer.
const PPS_FETCH: Opcode = opcode::read_write::<*mut PpsFetch>(b'p', 0xa4);

// SAFETY: the opcode belongs to this structure (linux/pps.h), which is repr(C), lives in the value for
// the whole call, and is written by the kernel only within its size.
unsafe impl Ioctl for PpsFetch {
    type Output = Self;
    const IS_MUTATING: bool = true;

    fn opcode(&self) -> Opcode {
        PPS_FETCH
    }

    fn as_ptr(&mut self) -> *mut std::ffi::c_void {
        std::ptr::from_mut(self).cast()
    }

    unsafe fn output_from_ptr(_: IoctlOutput, pointer: *mut std::ffi::c_void) -> rustix::io::Result<Self> {
        // SAFETY: `pointer` is the result of `as_ptr`, and still valid.
        Ok(unsafe { *pointer.cast::<Self>() })
    }
}

/// Watches a pulse line without end; `pulse` gets the host time of each rising edge.
pub async fn run(
    device: &str,
    clock: HostClock,
    reports: Reports<'_>,
    pulse: &(dyn Fn(MonoTime) + Sync),
) -> Infallible {
    let path = device.to_owned();
    let open = move || File::open(&path).map_err(|error| Fault::from_io(&path, &error));
    let watched = async |file| {
        reports(Report::Up(format!("pulses of {device}")));
        let Err(error) = watch(file, clock, reports, pulse).await;
        Fault::new(FaultKind::Unplugged, device, error.to_string())
    };
    watch_line(open, watched, reports).await
}

/// Until the line is lost. The kernel wakes waiters at every edge; before Linux 6.14 it also reports at any time that
/// the device can be read, so only a wake-up counts (epoll's edge trigger, which the runtime requests).
async fn watch(
    file: File,
    clock: HostClock,
    reports: Reports<'_>,
    pulse: &(dyn Fn(MonoTime) + Sync),
) -> io::Result<Infallible> {
    // This call fails for a device that is not a pulse line.
    let mut last = fetch(&file)?.assert_sequence;
    let line = register(file, Interest::READABLE)?;
    loop {
        // Cleared first: an edge from here on wakes again.
        wait_for(line.readable(), reports).await?.clear_ready();
        let edge = fetch(line.get_ref())?;
        let new = std::mem::replace(&mut last, edge.assert_sequence) != edge.assert_sequence;
        if new && let (Ok(sec), Ok(nsec)) = (u64::try_from(edge.assert.sec), u32::try_from(edge.assert.nsec))
        {
            pulse(clock.from_realtime(Duration::new(sec, nsec)));
        }
    }
}

/// The latest edge, at once: a time-out of zero does not wait.
fn fetch(file: &File) -> io::Result<PpsFetch> {
    // SAFETY: see the implementation of `Ioctl` above; the file is open for the whole call.
    Ok(unsafe { ioctl(file.as_fd(), PpsFetch::default()) }?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_structure_is_the_kernels() {
        // linux/pps.h on 64-bit: 8 + 16 + 16 + 4 (+ 4 of padding) + 16.
        assert_eq!(size_of::<PpsFetch>(), 64);
        assert_eq!(PPS_FETCH, 0xc008_70a4);
    }

    #[tokio::test]
    async fn what_is_no_pulse_line_is_reported() {
        let (sender, mut faults) = tokio::sync::mpsc::unbounded_channel();
        let reports = move |report| {
            if let Report::Down(fault) = report {
                let _ = sender.send(fault);
            }
        };
        let kind = tokio::select! {
            fault = faults.recv() => fault.map(|fault| fault.kind),
            never = run("/dev/null", HostClock::start(), &reports, &|_| {}) => match never {},
        };
        assert_eq!(kind, Some(FaultKind::Unplugged));
    }
}
