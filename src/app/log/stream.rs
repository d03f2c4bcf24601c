//! Standard output and standard error as sinks write them: straight to the descriptor. The library's handles have a
//! lock, and a writer that is stuck with it would hold up whoever writes next.

use std::io::{self, Write};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use rustix::fd::BorrowedFd;
use rustix::io::Errno;

/// Where it goes.
#[derive(Clone, Copy, Debug)]
pub enum Stream {
    /// Standard output.
    Out,
    /// Standard error.
    Error,
}

impl Stream {
    fn descriptor(self) -> BorrowedFd<'static> {
        match self {
            Self::Out => rustix::stdio::stdout(),
            Self::Error => rustix::stdio::stderr(),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        loop {
            match rustix::io::write(self.descriptor(), bytes) {
                // Somebody made the descriptor non-blocking: waiting is ours.
                Err(Errno::AGAIN) => {
                    let descriptor = self.descriptor();
                    let _ = poll(&mut [PollFd::new(&descriptor, PollFlags::OUT)], None);
                }
                Err(Errno::INTR) => {}
                result => return result.map_err(Into::into),
            }
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Longest that a program's last words are waited for.
const LAST_WORDS: Duration = Duration::from_millis(300);

/// Writes a program's last words on standard error; where nobody takes them, they are lost.
pub fn last_words(words: &str) {
    let text = format!("{words}\n");
    let (written, waiting) = std::sync::mpsc::sync_channel(1);
    let writer = std::thread::Builder::new().name("last words".into()).spawn(move || {
        let _ = Stream::Error.write_all(text.as_bytes());
        let _ = written.send(());
    });
    if writer.is_ok() {
        let _ = waiting.recv_timeout(LAST_WORDS);
    }
}
