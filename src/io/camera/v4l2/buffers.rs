//! The stream of mapped buffers of a V4L2 node, with one memory plane a frame.

use std::io;
use std::ops::Range;
use std::os::fd::BorrowedFd;
use std::ptr::NonNull;
use std::time::Duration;

use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use v4l::v4l_sys::{v4l2_buffer, v4l2_plane};
use v4l::v4l2::{self, vidioc};

use super::node::{Api, MEMORY_MMAP, Node};

/// `VIDEO_MAX_PLANES`: the kernel writes no more.
const MOST_PLANES: usize = 8;

/// A frame in its buffer.
pub(super) struct Filled<'a> {
    /// The frame's bytes.
    pub(super) bytes: &'a [u8],
    /// The driver's count of frames.
    pub(super) sequence: u32,
    /// `V4L2_BUF_FLAG_…`.
    pub(super) flags: u32,
    /// The driver's stamp, of the clock that the flags name.
    pub(super) stamp: Duration,
}

/// A running stream. Dropped, it ends.
pub(super) struct Buffers {
    node: Node,
    maps: Vec<Mapping>,
}

/// A mapped buffer of the driver.
struct Mapping {
    start: NonNull<u8>,
    len: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread.
unsafe impl Send for Mapping {}
// SAFETY: it is read in `Buffers::next` only, which has its owner for itself.
unsafe impl Sync for Mapping {}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped in `Buffers::map`, and no slice of it outlives its owner.
        let _ = unsafe { munmap(self.start.as_ptr().cast(), self.len) };
    }
}

impl Buffers {
    /// Maps up to `count` buffers, gives all to the driver, and starts the stream.
    pub(super) fn start(node: Node, count: u32) -> io::Result<Self> {
        let count = node.request_buffers(count)?;
        if count == 0 {
            return Err(io::Error::other("the driver has no memory for frames"));
        }
        let mut buffers = Self { node, maps: Vec::new() };
        for index in 0..count {
            let mapping = buffers.map(index)?;
            buffers.maps.push(mapping);
        }
        for index in 0..count {
            buffers.queue(index)?;
        }
        buffers.node.set_streaming(true)?;
        Ok(buffers)
    }

    fn map(&self, index: u32) -> io::Result<Mapping> {
        let mut planes = no_planes();
        let buffer = self.call(vidioc::VIDIOC_QUERYBUF, index, &mut planes)?;
        // SAFETY: the driver sets the offset of a buffer for mapping; any bytes are a valid value of it.
        let (len, offset) = match self.node.api {
            Api::Single => (buffer.length, unsafe { buffer.m.offset }),
            Api::Planes => (planes[0].length, unsafe { planes[0].m.mem_offset }),
        };
        let len = len as usize;
        let handle = self.node.handle();
        // SAFETY: the handle's descriptor is open until the end of this function. The mapping is a new one, of the length
        // that the driver states.
        let start = unsafe {
            let fd = BorrowedFd::borrow_raw(handle.fd());
            let (access, flags) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED);
            mmap(std::ptr::null_mut(), len, access, flags, fd, u64::from(offset))?
        };
        let start =
            NonNull::new(start.cast()).ok_or_else(|| io::Error::other("a buffer could not be mapped"))?;
        Ok(Mapping { start, len })
    }

    fn queue(&self, index: u32) -> io::Result<()> {
        self.call(vidioc::VIDIOC_QBUF, index, &mut no_planes()).map(drop)
    }

    /// Takes the next frame and gives its buffer back to the driver. [`io::ErrorKind::WouldBlock`] where there is none yet.
    pub(super) fn next<T>(&mut self, take: impl FnOnce(&Filled<'_>) -> T) -> io::Result<T> {
        let mut planes = no_planes();
        let buffer = self.call(vidioc::VIDIOC_DQBUF, 0, &mut planes)?;
        let mapping = self
            .maps
            .get(buffer.index as usize)
            .ok_or_else(|| io::Error::other("the driver returned a buffer that it has not"))?;
        let (used, offset) = match self.node.api {
            Api::Single => (buffer.bytesused, 0),
            Api::Planes => (planes[0].bytesused, planes[0].data_offset),
        };
        // SAFETY: mapped with this length for as long as `self` lives; the driver does not write to it before it is queued
        // again, which follows below.
        let all = unsafe { std::slice::from_raw_parts(mapping.start.as_ptr(), mapping.len) };
        let taken = take(&Filled {
            bytes: &all[frame_bytes(mapping.len, used, offset)],
            sequence: buffer.sequence,
            flags: buffer.flags,
            stamp: since(buffer.timestamp.tv_sec, buffer.timestamp.tv_usec),
        });
        self.queue(buffer.index)?;
        Ok(taken)
    }

    /// A request about one buffer.
    fn call(
        &self,
        request: vidioc::_IOC_TYPE,
        index: u32,
        planes: &mut [v4l2_plane; MOST_PLANES],
    ) -> io::Result<v4l2_buffer> {
        // SAFETY: zero bytes are a valid value of the structure.
        let mut buffer: v4l2_buffer = unsafe { std::mem::zeroed() };
        (buffer.index, buffer.type_, buffer.memory) = (index, self.node.api.buffer_type(), MEMORY_MMAP);
        if self.node.api == Api::Planes {
            (buffer.m.planes, buffer.length) = (planes.as_mut_ptr(), MOST_PLANES as u32);
        }
        let handle = self.node.handle();
        // SAFETY: QUERYBUF, QBUF and DQBUF take this structure; it and the planes to which it points live until the call
        // returns, and their number is stated. The handle's descriptor is open.
        unsafe { v4l2::ioctl(handle.fd(), request, std::ptr::from_mut(&mut buffer).cast())? };
        Ok(buffer)
    }
}

impl Drop for Buffers {
    fn drop(&mut self) {
        // A device that has disappeared refuses this, and there is nothing to end.
        let _ = self.node.set_streaming(false);
    }
}

fn no_planes() -> [v4l2_plane; MOST_PLANES] {
    // SAFETY: zero bytes are a valid value of the structure.
    unsafe { std::mem::zeroed() }
}

/// The frame's bytes in a buffer of `len` bytes: `used` counts from the buffer's begin and 0 stands for all of it
/// (drivers of raw formats), `offset` bytes at the begin are not of the frame.
fn frame_bytes(len: usize, used: u32, offset: u32) -> Range<usize> {
    let end = if used == 0 { len } else { (used as usize).min(len) };
    (offset as usize).min(end)..end
}

/// Time since the clock's zero; zero where it is negative.
fn since(sec: impl TryInto<u64>, usec: impl TryInto<u64>) -> Duration {
    let sec = Duration::from_secs(sec.try_into().unwrap_or(0));
    sec.saturating_add(Duration::from_micros(usec.try_into().unwrap_or(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_the_used_part_of_its_buffer() {
        assert_eq!(frame_bytes(4096, 3000, 0), 0..3000);
        assert_eq!(frame_bytes(4096, 0, 0), 0..4096);
        assert_eq!(frame_bytes(4096, 9000, 0), 0..4096);
        assert_eq!(frame_bytes(4096, 3064, 64), 64..3064);
        assert_eq!(frame_bytes(4096, 0, 64), 64..4096);
        assert_eq!(frame_bytes(4096, 32, 64), 32..32);
    }

    #[test]
    fn stamps_of_processors_of_32_bits_are_whole() {
        // A `time_t` of 32 bits: an hour in microseconds is beyond it.
        assert_eq!(since(3_600_i32, 250_000_i32), Duration::from_millis(3_600_250));
        assert_eq!(since(-1_i64, 5_i64), Duration::from_micros(5));
    }
}
