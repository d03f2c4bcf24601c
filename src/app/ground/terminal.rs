//! The station's terminal: lines that stay, and status lines of the payloads, which a terminal rewrites in place. It
//! has its own queue: a stopped terminal, or a pipe that nobody reads, blocks nothing.

use std::fmt::Display;
use std::io::{self, Write};

use crate::app::log::{Queue, QueueEnd, Stream, queue};
use crate::io::clock::HostClock;
use crate::text::one_line;
use windhover_base::time::Span;

/// First byte of a status message, which replaces the previous status.
const STATUS: u8 = b'\r';
/// Longest wait at the end for lines that are still queued.
const ENDING: Span = Span::from_ns(400_000_000);

/// Standard output. Copies share the same queue.
#[derive(Clone)]
pub(super) struct Terminal(Queue);

/// Ends the terminal when dropped: queued lines are shown first, unless the terminal is stuck.
pub(super) struct TerminalEnd {
    terminal: Terminal,
    /// Dropped after the wait.
    _end: QueueEnd,
}

impl Terminal {
    /// Starts the terminal; `rewrites` where lines are rewritten in place.
    pub(super) fn start(rewrites: bool) -> TerminalEnd {
        let (queue, end) = queue("stdout", Screen { out: Stream::Out, rewrites, shown: 0 });
        TerminalEnd { terminal: Self(queue), _end: end }
    }

    /// Shows a line that stays. Control sequences in it are escaped, whatever its source.
    pub(super) fn line(&self, text: impl Display) {
        self.0.put(format!("{}\n", one_line(&text.to_string())).as_bytes());
    }

    /// Shows the status, one line for each payload, in place of the previous status.
    pub(super) fn status(&self, lines: &[String]) {
        let mut message = vec![STATUS];
        for line in lines {
            message.extend_from_slice(one_line(line).as_bytes());
            message.push(b'\n');
        }
        self.0.put(&message);
    }
}

impl TerminalEnd {
    /// The terminal, for code that shows something.
    pub(super) fn terminal(&self) -> &Terminal {
        &self.terminal
    }
}

impl Drop for TerminalEnd {
    fn drop(&mut self) {
        let clock = HostClock::start();
        self.terminal.0.drain(clock, clock.now() + ENDING);
    }
}

/// The far end of the queue: it knows what was shown last, whatever was dropped before.
struct Screen<W> {
    out: W,
    rewrites: bool,
    /// Lines of the status on the screen.
    shown: usize,
}

impl<W: Write> Write for Screen<W> {
    fn write(&mut self, message: &[u8]) -> io::Result<usize> {
        match message.strip_prefix(&[STATUS]) {
            None => self.out.write_all(message)?,
            Some(status) if !self.rewrites => self.out.write_all(status)?,
            Some(status) => {
                let mut text = match self.shown {
                    0 => String::new(),
                    shown => format!("\x1b[{shown}A"),
                };
                text.push_str(&String::from_utf8_lossy(status).replace('\n', "\x1b[K\n"));
                self.shown = status.iter().filter(|byte| **byte == b'\n').count();
                self.out.write_all(text.as_bytes())?;
            }
        }
        Ok(message.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_others_say_steers_no_terminal() {
        #[derive(Clone, Default)]
        struct Shown(std::sync::Arc<std::sync::Mutex<Vec<u8>>>);
        impl Write for Shown {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.lock().expect("not poisoned").write(bytes)
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let out = Shown::default();
        let (queue, end) = queue("test", Screen { out: out.clone(), rewrites: false, shown: 0 });
        let terminal = Terminal(queue);
        terminal.line("from \x1b[2Jme\nforged line");
        terminal.status(&["bird\x1b]0;title\x07 up\r\nhawk down".to_owned()]);
        drop(TerminalEnd { terminal, _end: end });
        let shown = String::from_utf8(out.0.lock().expect("not poisoned").clone()).expect("UTF-8");
        let expected = "from \\u{1b}[2Jme\\nforged line\nbird\\u{1b}]0;title\\u{7} up\\r\\nhawk down\n";
        assert_eq!(shown, expected);
    }

    #[test]
    fn a_terminal_shows_the_status_in_place_and_a_pipe_line_by_line() {
        let shown = |rewrites| {
            let mut screen = Screen { out: Vec::new(), rewrites, shown: 0 };
            for message in ["page at http://\n", "\rbird up\nhawk up\n", "\rbird down\n", "\rbird up\n"] {
                screen.write_all(message.as_bytes()).expect("shown");
            }
            String::from_utf8(screen.out).expect("UTF-8")
        };
        assert_eq!(shown(false), "page at http://\nbird up\nhawk up\nbird down\nbird up\n");
        let rewritten =
            "page at http://\nbird up\x1b[K\nhawk up\x1b[K\n\x1b[2Abird down\x1b[K\n\x1b[1Abird up\x1b[K\n";
        assert_eq!(shown(true), rewritten);
    }
}
