//! The devices of a live simulation: serial lines as pseudo-terminals, the camera as a Unix socket.

use std::fs::File;
use std::io::{ErrorKind, Read as _, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::Duration;

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::io::camera::grey_header;
use crate::io::clock::HostClock;
use windhover_base::msg::{FramePayload, GrayImage};
use windhover_base::time::Span;
use windhover_simulate::render::Renderer;
use windhover_simulate::{FrameTruth, World};

/// A daemon that takes no frame for this time is gone.
const TAKES_BY: Duration = Duration::from_millis(500);

/// A serial line whose near end a daemon opens by the name of a link.
#[derive(Debug)]
pub struct PtyLine {
    link: PathBuf,
    far: File,
    /// The near end stays open here too: writing while no daemon has it open is then no error.
    _near: File,
}

impl PtyLine {
    /// A line whose near end is at `link`.
    pub fn open(link: PathBuf) -> std::io::Result<Self> {
        let far: OwnedFd = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&far)?;
        unlockpt(&far)?;
        let name = ptsname(&far, Vec::new())?.into_string().map_err(std::io::Error::other)?;
        let near = File::options().read(true).write(true).open(&name)?;
        let mut raw = tcgetattr(&near)?;
        raw.make_raw();
        tcsetattr(&near, OptionalActions::Now, &raw)?;
        let _ = std::fs::remove_file(&link);
        std::os::unix::fs::symlink(&name, &link)?;
        let flags = fcntl_getfl(&far)?;
        fcntl_setfl(&far, flags | OFlags::NONBLOCK)?;
        Ok(Self { link, far: File::from(far), _near: near })
    }

    /// Sends bytes; bytes for a line that nobody reads are lost, as on a real one.
    pub fn send(&mut self, bytes: &[u8]) {
        let _ = self.far.write_all(bytes);
    }

    /// Bytes from the near end.
    pub fn receive(&mut self) -> Vec<u8> {
        let (mut all, mut buffer) = (Vec::new(), [0; 4096]);
        while let Ok(count @ 1..) = self.far.read(&mut buffer) {
            all.extend_from_slice(&buffer[..count]);
        }
        all
    }
}

impl Drop for PtyLine {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.link);
    }
}

/// Frames for the client of a socket.
#[derive(Debug)]
pub struct FrameSocket {
    path: PathBuf,
    listener: UnixListener,
    daemon: Option<UnixStream>,
    /// Host time less CLOCK_MONOTONIC.
    less_monotonic: Span,
}

impl FrameSocket {
    /// Listens at `path`.
    pub fn open(path: &Path, less_monotonic: Span) -> std::io::Result<Self> {
        let _ = std::fs::remove_file(path);
        let listener = UnixListener::bind(path)?;
        listener.set_nonblocking(true)?;
        Ok(Self { path: path.to_owned(), listener, daemon: None, less_monotonic })
    }

    /// Sends a grey frame to the connected client.
    pub fn send(&mut self, frame: &FramePayload) {
        match self.listener.accept() {
            Ok((daemon, _)) => {
                let set =
                    daemon.set_nonblocking(false).and_then(|()| daemon.set_write_timeout(Some(TAKES_BY)));
                self.daemon = set.is_ok().then_some(daemon);
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => self.daemon = None,
        }
        let stamp_ns = frame.t_exposure.ns() - self.less_monotonic.ns();
        let header = grey_header(stamp_ns, frame.width, frame.height);
        if let Some(daemon) = &mut self.daemon
            && daemon.write_all(&header).and_then(|()| daemon.write_all(&frame.data)).is_err()
        {
            self.daemon = None;
        }
    }
}

/// Renders and sends frames in its own thread: lines keep their timing however long a frame takes.
#[derive(Debug)]
pub struct FrameRenderer {
    exposed: SyncSender<FrameTruth>,
}

/// Frames that wait to be rendered; a frame that finds this many before it is lost, as by a driver that is read too
/// late.
const WAITING: usize = 2;

impl FrameRenderer {
    /// Renders frames of a world for the client of a socket.
    pub fn open(
        world: Arc<World>,
        mut socket: FrameSocket,
        clock: HostClock,
        threads: usize,
    ) -> std::io::Result<Self> {
        let (exposed, frames) = sync_channel::<FrameTruth>(WAITING);
        let draw = move || {
            let (renderer, mut image) = (Renderer::new(world).with_threads(threads), GrayImage::default());
            for truth in frames {
                renderer.render(truth.t_true, truth.frame, &mut image);
                let frame = truth.in_grey(image.clone());
                if let Ok(left) = u64::try_from((truth.t_recv - clock.now()).ns()) {
                    std::thread::sleep(Duration::from_nanos(left));
                }
                socket.send(&frame);
            }
        };
        std::thread::Builder::new().name("frames".into()).spawn(draw)?;
        Ok(Self { exposed })
    }

    /// A frame was exposed.
    pub fn draw(&self, frame: FrameTruth) {
        let _ = self.exposed.try_send(frame);
    }
}

impl Drop for FrameSocket {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}
