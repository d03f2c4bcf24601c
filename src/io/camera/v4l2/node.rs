//! The calls of a V4L2 capture node, of one plane or of several (`linux/videodev2.h`).

use std::io;
use std::marker::PhantomData;
use std::sync::Arc;

use v4l::Device;
use v4l::device::Handle;
use v4l::v4l_sys::{
    V4L2_CAP_DEVICE_CAPS, V4L2_CAP_STREAMING, V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE,
    V4L2_CTRL_FLAG_DISABLED, V4L2_CTRL_FLAG_READ_ONLY, v4l2_capability, v4l2_control, v4l2_fmtdesc,
    v4l2_format, v4l2_pix_format, v4l2_pix_format_mplane, v4l2_queryctrl, v4l2_requestbuffers,
    v4l2_streamparm,
};
use v4l::v4l2::{self, vidioc};

use super::format::FourCc;

/// The two forms of the capture interface. Capture units of SoCs (Rockchip, i.MX) have only the second.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Api {
    /// `V4L2_CAP_VIDEO_CAPTURE`.
    Single,
    /// `V4L2_CAP_VIDEO_CAPTURE_MPLANE`.
    Planes,
}

impl Api {
    /// `enum v4l2_buf_type`.
    pub(super) const fn buffer_type(self) -> u32 {
        match self {
            Self::Single => 1,
            Self::Planes => 9,
        }
    }

    /// The form of a node that has these capabilities; `None` where it captures no stream.
    fn of(caps: u32) -> Option<Self> {
        let has = |flag| caps & flag != 0;
        match (has(V4L2_CAP_STREAMING), has(V4L2_CAP_VIDEO_CAPTURE), has(V4L2_CAP_VIDEO_CAPTURE_MPLANE)) {
            (true, true, _) => Some(Self::Single),
            (true, false, true) => Some(Self::Planes),
            _ => None,
        }
    }
}

/// A structure of `linux/videodev2.h`.
///
/// # Safety
///
/// Zero bytes must be a valid value of it, and a call with it must follow no pointer in it.
unsafe trait Plain: Sized {
    /// Every field zero.
    fn zero() -> Self {
        // SAFETY: the trait's condition.
        unsafe { std::mem::zeroed() }
    }
}

// SAFETY: figures, arrays of figures and unions of both; none of the requests below follows a pointer of a format.
unsafe impl Plain for v4l2_capability {}
// SAFETY: as above.
unsafe impl Plain for v4l2_control {}
// SAFETY: as above.
unsafe impl Plain for v4l2_fmtdesc {}
// SAFETY: as above.
unsafe impl Plain for v4l2_format {}
// SAFETY: as above.
unsafe impl Plain for v4l2_queryctrl {}
// SAFETY: as above.
unsafe impl Plain for v4l2_requestbuffers {}
// SAFETY: as above.
unsafe impl Plain for v4l2_streamparm {}
// SAFETY: as above.
unsafe impl Plain for std::os::raw::c_int {}

/// A request and the structure that it takes.
struct Request<T>(vidioc::_IOC_TYPE, PhantomData<fn(T)>);

/// Pairs each request with its structure, as `linux/videodev2.h` defines them.
macro_rules! requests {
    ($($name:ident: $argument:ty = $code:ident;)*) => { $(
        const $name: Request<$argument> = Request(vidioc::$code, PhantomData);
    )* };
}

requests! {
    QUERYCAP: v4l2_capability = VIDIOC_QUERYCAP;
    ENUM_FMT: v4l2_fmtdesc = VIDIOC_ENUM_FMT;
    S_FMT: v4l2_format = VIDIOC_S_FMT;
    S_PARM: v4l2_streamparm = VIDIOC_S_PARM;
    REQBUFS: v4l2_requestbuffers = VIDIOC_REQBUFS;
    STREAMON: std::os::raw::c_int = VIDIOC_STREAMON;
    STREAMOFF: std::os::raw::c_int = VIDIOC_STREAMOFF;
    QUERYCTRL: v4l2_queryctrl = VIDIOC_QUERYCTRL;
    G_CTRL: v4l2_control = VIDIOC_G_CTRL;
    S_CTRL: v4l2_control = VIDIOC_S_CTRL;
}

/// What a driver set when a format was requested.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Given {
    pub(super) code: FourCc,
    pub(super) width: u32,
    pub(super) height: u32,
    /// Bytes from row to row; 0 where the driver leaves it out.
    pub(super) stride: u32,
    /// Memory planes of a frame.
    pub(super) planes: u8,
}

/// Limits of a control.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Limits {
    pub(super) least: i32,
    pub(super) most: i32,
    pub(super) step: i32,
}

impl Limits {
    /// The nearest value that the control takes.
    pub(super) fn nearest(self, value: f64) -> i32 {
        let step = f64::from(self.step.max(1));
        let steps = ((value - f64::from(self.least)) / step).round();
        let on_grid = f64::from(self.least) + steps * step;
        on_grid.clamp(f64::from(self.least), f64::from(self.most)) as i32
    }
}

/// An open capture node.
#[derive(Clone)]
pub(super) struct Node {
    handle: Arc<Handle>,
    pub(super) api: Api,
    /// The card's name.
    pub(super) card: String,
    /// The driver's name.
    pub(super) driver: String,
}

/// Why a node cannot be used.
pub(super) enum NotOpen {
    /// The system refuses.
    Io(io::Error),
    /// The file is no V4L2 node.
    NoCamera,
    /// The node of this card delivers no video stream.
    NoStream(String),
}

impl Node {
    /// Opens a node. Its calls never wait for a frame.
    pub(super) fn open(path: &str) -> Result<Self, NotOpen> {
        let handle = Device::with_path(path).map_err(NotOpen::Io)?.handle();
        let mut caps = v4l2_capability::zero();
        call(&handle, &QUERYCAP, &mut caps).map_err(|_| NotOpen::NoCamera)?;
        let of_node =
            if caps.capabilities & V4L2_CAP_DEVICE_CAPS != 0 { caps.device_caps } else { caps.capabilities };
        let card = words(&caps.card);
        match Api::of(of_node) {
            Some(api) => Ok(Self { handle, api, card, driver: words(&caps.driver) }),
            None => Err(NotOpen::NoStream(card)),
        }
    }

    /// The descriptor and its owner.
    pub(super) fn handle(&self) -> Arc<Handle> {
        Arc::clone(&self.handle)
    }

    /// Codes of the offered formats.
    pub(super) fn formats(&self) -> Vec<FourCc> {
        let mut codes = Vec::new();
        for index in 0..256 {
            let mut format = v4l2_fmtdesc::zero();
            (format.index, format.type_) = (index, self.api.buffer_type());
            if call(&self.handle, &ENUM_FMT, &mut format).is_err() {
                break;
            }
            codes.push(format.pixelformat.to_le_bytes());
        }
        codes
    }

    /// Requests a format; returns the one that the driver sets.
    pub(super) fn set_format(&self, code: FourCc, width: u32, height: u32) -> io::Result<Given> {
        let mut format = v4l2_format::zero();
        format.type_ = self.api.buffer_type();
        match self.api {
            Api::Single => format.fmt.pix = requested(code, width, height),
            Api::Planes => format.fmt.pix_mp = requested_planes(code, width, height),
        }
        call(&self.handle, &S_FMT, &mut format)?;
        // SAFETY: the driver fills the member of the request's type; any bytes are a valid value of either.
        Ok(match self.api {
            Api::Single => given(unsafe { &format.fmt.pix }),
            Api::Planes => given_planes(unsafe { &format.fmt.pix_mp }),
        })
    }

    /// Requests a frame rate; returns the rate that the driver sets, frames a second. Drivers without this call have a
    /// fixed rate.
    pub(super) fn set_rate(&self, fps: f64) -> Option<f64> {
        let mut params = v4l2_streamparm::zero();
        params.type_ = self.api.buffer_type();
        params.parm.capture.timeperframe.numerator = 1000;
        params.parm.capture.timeperframe.denominator = (fps * 1000.0).round() as u32;
        call(&self.handle, &S_PARM, &mut params).ok()?;
        // SAFETY: the member of a capture type; any bytes are a valid value of it.
        let interval = unsafe { params.parm.capture.timeperframe };
        let known = interval.numerator > 0 && interval.denominator > 0;
        known.then(|| f64::from(interval.denominator) / f64::from(interval.numerator))
    }

    /// Requests buffers that can be mapped; returns how many there are.
    pub(super) fn request_buffers(&self, count: u32) -> io::Result<u32> {
        let mut request = v4l2_requestbuffers::zero();
        (request.count, request.type_, request.memory) = (count, self.api.buffer_type(), MEMORY_MMAP);
        call(&self.handle, &REQBUFS, &mut request)?;
        Ok(request.count)
    }

    /// Starts the stream, or ends it.
    pub(super) fn set_streaming(&self, on: bool) -> io::Result<()> {
        let mut buffer_type = self.api.buffer_type() as std::os::raw::c_int;
        call(&self.handle, if on { &STREAMON } else { &STREAMOFF }, &mut buffer_type)
    }

    /// The limits of a control; `None` where the node does not have it or does not let it be set.
    pub(super) fn limits(&self, id: u32) -> Option<Limits> {
        let mut control = v4l2_queryctrl::zero();
        control.id = id;
        call(&self.handle, &QUERYCTRL, &mut control).ok()?;
        let usable = control.flags & (V4L2_CTRL_FLAG_DISABLED | V4L2_CTRL_FLAG_READ_ONLY) == 0;
        usable.then_some(Limits { least: control.minimum, most: control.maximum, step: control.step })
    }

    /// The value of a control.
    pub(super) fn control(&self, id: u32) -> Option<i32> {
        let mut control = v4l2_control { id, value: 0 };
        call(&self.handle, &G_CTRL, &mut control).ok()?;
        Some(control.value)
    }

    /// Sets a control.
    pub(super) fn set_control(&self, id: u32, value: i32) -> io::Result<()> {
        call(&self.handle, &S_CTRL, &mut v4l2_control { id, value })
    }
}

/// `V4L2_MEMORY_MMAP`.
pub(super) const MEMORY_MMAP: u32 = 1;

fn call<T: Plain>(handle: &Handle, request: &Request<T>, value: &mut T) -> io::Result<()> {
    loop {
        // SAFETY: the request takes a `T` (`requests!`), which is valid for reading and writing during the call, and the
        // kernel follows no pointer in it (`Plain`). The handle's descriptor is open.
        let result = unsafe { v4l2::ioctl(handle.fd(), request.0, std::ptr::from_mut(value).cast()) };
        match result {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            result => return result,
        }
    }
}

/// Text of a field that ends at its first zero byte.
fn words(bytes: &[u8]) -> String {
    let text = bytes.split(|&byte| byte == 0).next().unwrap_or_default();
    String::from_utf8_lossy(text).into_owned()
}

fn requested(code: FourCc, width: u32, height: u32) -> v4l2_pix_format {
    let mut format = v4l2_format::zero();
    format.fmt.pix.width = width;
    format.fmt.pix.height = height;
    format.fmt.pix.pixelformat = u32::from_le_bytes(code);
    // SAFETY: zero bytes but for the fields above.
    unsafe { format.fmt.pix }
}

fn requested_planes(code: FourCc, width: u32, height: u32) -> v4l2_pix_format_mplane {
    let mut format = v4l2_format::zero();
    format.fmt.pix_mp.width = width;
    format.fmt.pix_mp.height = height;
    format.fmt.pix_mp.pixelformat = u32::from_le_bytes(code);
    // SAFETY: zero bytes but for the fields above.
    unsafe { format.fmt.pix_mp }
}

fn given(format: &v4l2_pix_format) -> Given {
    Given {
        code: format.pixelformat.to_le_bytes(),
        width: format.width,
        height: format.height,
        stride: format.bytesperline,
        planes: 1,
    }
}

fn given_planes(format: &v4l2_pix_format_mplane) -> Given {
    // The structure is packed: its fields are copied before they are used.
    let (code, first) = (format.pixelformat, format.plane_fmt[0]);
    Given {
        code: code.to_le_bytes(),
        width: format.width,
        height: format.height,
        stride: first.bytesperline,
        planes: format.num_planes,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_of_one_plane_where_it_can_be() {
        let (single, planes) = (V4L2_CAP_VIDEO_CAPTURE, V4L2_CAP_VIDEO_CAPTURE_MPLANE);
        assert_eq!(Api::of(V4L2_CAP_STREAMING | single), Some(Api::Single));
        assert_eq!(Api::of(V4L2_CAP_STREAMING | planes), Some(Api::Planes));
        assert_eq!(Api::of(V4L2_CAP_STREAMING | single | planes), Some(Api::Single));
        assert_eq!(Api::of(single | planes), None);
        assert_eq!(Api::of(V4L2_CAP_STREAMING), None);
    }

    #[test]
    fn a_format_of_planes_is_read_from_its_packed_structure() {
        let mut format = requested_planes(*b"NV12", 1280, 1024);
        format.num_planes = 1;
        format.plane_fmt[0].bytesperline = 1344;
        let expected = Given { code: *b"NV12", width: 1280, height: 1024, stride: 1344, planes: 1 };
        assert_eq!(given_planes(&format), expected);
    }

    #[test]
    fn a_control_gets_a_value_of_its_grid() {
        let limits = Limits { least: 3, most: 2047, step: 4 };
        assert_eq!(limits.nearest(20.0), 19);
        assert_eq!(limits.nearest(0.0), 3);
        assert_eq!(limits.nearest(1e9), 2047);
        assert_eq!(Limits { least: 1, most: 10, step: 0 }.nearest(4.4), 4);
    }

    #[test]
    fn what_is_no_camera_is_not_opened() {
        assert!(matches!(Node::open("/dev/null"), Err(NotOpen::NoCamera)));
        assert!(matches!(Node::open("/nowhere/video0"), Err(NotOpen::Io(_))));
    }
}
