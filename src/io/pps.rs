//! Pulse per second: the kernel's stamps of a receiver's pulse (Linux `/dev/ppsN`, RFC 2783).

use std::fs::File;
use std::os::fd::AsFd;
use std::time::Duration;

use rustix::ioctl::{Ioctl, IoctlOutput, Opcode, ioctl, opcode};

use super::clock::HostClock;
use super::device::{Backoff, Fault, FaultKind, Report, Stop};
use windhover_base::time::MonoTime;

/// `struct pps_ktime` of linux/pps.h.
#[repr(C)]
#[derive(Clone, Copy, Default)]
struct PpsTime {
    sec: i64,
    nsec: i32,
    flags: u32,
}

/// `struct pps_fdata` of linux/pps.h: its `pps_kinfo`, then how long to wait.
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

/// `PPS_FETCH`, `_IOWR('p', 0xa4, struct pps_fdata *)`: the header puts a pointer's size in.
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
        // SAFETY: `pointer` is what `as_ptr` gave, still valid.
        Ok(unsafe { *pointer.cast::<Self>() })
    }
}

/// Watches a pulse line until the end is asked for. Runs on the calling thread; `pulse` gets the host
/// time of each rising edge.
pub fn run(device: &str, clock: HostClock, stop: &Stop, tell: &dyn Fn(Report), pulse: &dyn Fn(MonoTime)) {
    let mut backoff = Backoff::new();
    while !stop.asked() {
        let fault = match File::open(device) {
            Ok(file) => {
                tell(Report::Up(format!("pulses of {device}")));
                backoff.reset();
                match watch(&file, device, clock, stop, tell, pulse) {
                    Some(fault) => fault,
                    None => return,
                }
            }
            Err(error) => Fault::from_io(device, &error),
        };
        tell(Report::Down(fault));
        backoff.wait(stop, tell);
    }
}

fn watch(
    file: &File,
    device: &str,
    clock: HostClock,
    stop: &Stop,
    tell: &dyn Fn(Report),
    pulse: &dyn Fn(MonoTime),
) -> Option<Fault> {
    let mut last = None;
    while !stop.asked() {
        tell(Report::Beat);
        match fetch(file) {
            Ok(fetched) => {
                let edge = fetched.assert;
                let new = last.replace(fetched.assert_sequence).is_some_and(|s| s != fetched.assert_sequence);
                if new && let (Ok(sec), Ok(nsec)) = (u64::try_from(edge.sec), u32::try_from(edge.nsec)) {
                    pulse(clock.from_realtime(Duration::new(sec, nsec)));
                }
            }
            Err(rustix::io::Errno::TIMEDOUT | rustix::io::Errno::INTR) => {}
            Err(error) => {
                return Some(Fault::new(FaultKind::Unplugged, device, error.to_string()));
            }
        }
    }
    None
}

/// Waits half a second at most for the next edge.
fn fetch(file: &File) -> rustix::io::Result<PpsFetch> {
    let timeout = PpsTime { sec: 0, nsec: 500_000_000, flags: 0 };
    let request = PpsFetch { timeout, ..PpsFetch::default() };
    // SAFETY: see the implementation of `Ioctl` above; the file is open for the whole call.
    unsafe { ioctl(file.as_fd(), request) }
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

    #[test]
    fn what_is_no_pulse_line_is_told() {
        use std::cell::Cell;
        let stop = Stop::default();
        let fault = Cell::new(None);
        let tell = |report| {
            if let Report::Down(told) = report {
                fault.set(Some(told));
                stop.ask();
            }
        };
        run("/dev/null", HostClock::start(), &stop, &tell, &|_| {});
        assert_eq!(fault.take().map(|f| f.kind), Some(FaultKind::Unplugged));
    }
}
