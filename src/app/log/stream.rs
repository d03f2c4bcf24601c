//! Standard output and standard error for sinks: written directly to the descriptor. The library's handles have a lock,
//! and a stuck writer that holds it would block the next one.

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
                // The descriptor was made non-blocking: the waiting is done here.
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

/// Longest wait for the program's final message.
const LAST_WORDS: Duration = Duration::from_millis(300);

/// Writes the program's final message on standard error; it is lost where nothing reads it.
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
