//! An open line, read when it is ready.

use std::io::{ErrorKind as IoKind, Read, Write};
use std::path::Path;
use std::time::Duration;

use serialport::{DataBits, StopBits, TTYPort};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::network::{Network, is_network};
use super::{SerialSettings, unplugged};
use windhover_base::settings::{Framing, Parity};

use crate::io::device::{Fault, FaultKind, Opened, OwnsDescriptor, blocking, register};

/// Longest that a line takes to accept a sentence.
const WRITING: Duration = Duration::from_millis(100);

// SAFETY: a port owns its descriptor and closes it when it is dropped.
unsafe impl OwnsDescriptor for TTYPort {}

/// A line that only this program has open.
#[derive(Debug)]
pub(in crate::io) struct Line {
    device: String,
    /// Empty for a network address, and while the port is on a thread for blocking work.
    port: Option<Opened<AsyncFd<TTYPort>>>,
    network: Option<Network>,
}

impl Line {
    /// Opens the line exclusively. The error distinguishes a busy, missing or forbidden device and one that is not a
    /// serial line.
    pub(in crate::io) async fn open(settings: &SerialSettings) -> Result<Self, Fault> {
        let SerialSettings { device, baud, framing, .. } = settings.clone();
        if is_network(&device) {
            let network = Some(Network::open(&device).await?);
            return Ok(Self { device, port: None, network });
        }
        let port = blocking(move || open(&device, baud, framing)).await?;
        let mut line = Self { device: settings.device.clone(), port: None, network: None };
        line.register(port)?;
        Ok(line)
    }

    /// Closes the line and waits until it is closed.
    pub(in crate::io) async fn close(self) {
        if let Some(port) = self.port {
            port.close().await;
        }
    }

    /// Waits for bytes and reads them; returns how many. Nothing is lost where the future is dropped.
    pub(in crate::io) async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Fault> {
        if let Some(network) = &mut self.network {
            return network.read(&self.device, buffer).await;
        }
        let lost = || unplugged(&self.device);
        let port = self.port.as_deref_mut().ok_or_else(lost)?;
        loop {
            let mut ready = port.readable_mut().await.map_err(|_| lost())?;
            match ready.try_io(|port| port.get_mut().read(buffer).map_err(not_ready)) {
                Ok(Ok(count)) if count > 0 => return Ok(count),
                Ok(Err(error)) if error.kind() == IoKind::Interrupted => {}
                Ok(_) => return Err(lost()),
                Err(_not_ready) => {}
            }
        }
    }

    /// Writes bytes.
    pub(in crate::io) async fn write(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        if let Some(network) = &mut self.network {
            return network.write(&self.device, bytes).await;
        }
        let lost = || unplugged(&self.device);
        let port = self.port.as_deref_mut().ok_or_else(lost)?;
        let writing = async {
            let mut left = bytes;
            while !left.is_empty() {
                let mut ready = port.writable_mut().await?;
                match ready.try_io(|port| port.get_mut().write(left).map_err(not_ready)) {
                    Ok(Ok(count)) => left = &left[count..],
                    Ok(Err(error)) if error.kind() == IoKind::Interrupted => {}
                    Ok(Err(error)) => return Err(error),
                    Err(_not_ready) => {}
                }
            }
            std::io::Result::Ok(())
        };
        match tokio::time::timeout(WRITING, writing).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(lost()),
        }
    }

    /// Changes the line's speed after all output was sent at the old one; received bytes are dropped.
    pub(super) async fn set_speed(&mut self, baud: u32) -> Result<(), Fault> {
        use serialport::SerialPort as _;
        let lost = || unplugged(&self.device);
        let port = self.port.take().ok_or_else(lost)?;
        let changed = blocking(move || {
            let mut port = port.into_inner()?.into_inner();
            // Waits until the output is sent.
            port.flush().ok()?;
            port.set_baud_rate(baud).ok()?;
            port.clear(serialport::ClearBuffer::Input).ok()?;
            Some(port)
        });
        self.register(changed.await.ok_or_else(lost)?)
    }

    fn register(&mut self, port: TTYPort) -> Result<(), Fault> {
        let port = register(port, Interest::READABLE | Interest::WRITABLE).map_err(|error| {
            Fault::new(FaultKind::Unsuitable, &self.device, format!("cannot be polled: {error}"))
        })?;
        self.port = Some(Opened::new(port));
        Ok(())
    }
}

/// The library waits for its time-out, which is zero here, where another program would get `EAGAIN`.
fn not_ready(error: std::io::Error) -> std::io::Error {
    if error.kind() == IoKind::TimedOut { IoKind::WouldBlock.into() } else { error }
}

fn open(device: &str, baud: u32, framing: Framing) -> Result<TTYPort, Fault> {
    if baud == 0 {
        return Err(Fault::new(FaultKind::Unsuitable, device, "line speed 0 hangs up; set baud"));
    }
    // The serial library has one error for several causes; the system calls distinguish them.
    std::fs::metadata(device).map_err(|e| Fault::from_io(device, &e))?;
    let data_bits = if framing.data_bits == 7 { DataBits::Seven } else { DataBits::Eight };
    let stop_bits = if framing.stop_bits == 2 { StopBits::Two } else { StopBits::One };
    let parity = match framing.parity {
        Parity::None => serialport::Parity::None,
        Parity::Even => serialport::Parity::Even,
        Parity::Odd => serialport::Parity::Odd,
    };
    let builder = serialport::new(device, baud).timeout(Duration::ZERO);
    let builder = builder.data_bits(data_bits).parity(parity).stop_bits(stop_bits);
    TTYPort::open(&builder).map_err(|error| fault_from_open(device, baud, &error))
}

fn fault_from_open(device: &str, baud: u32, error: &serialport::Error) -> Fault {
    use serialport::ErrorKind;
    match error.kind() {
        ErrorKind::NoDevice => {
            Fault::new(FaultKind::Busy, device, "another program uses the port; stop that program")
        }
        ErrorKind::Io(IoKind::NotFound) => {
            Fault::new(FaultKind::Missing, device, "does not exist; is it plugged in?")
        }
        ErrorKind::Io(IoKind::PermissionDenied) => Fault::new(
            FaultKind::Denied,
            device,
            "permission denied; add this user to the group that owns it (dialout)",
        ),
        _ if !Path::new(device).exists() => {
            Fault::new(FaultKind::Missing, device, "does not exist; is it plugged in?")
        }
        ErrorKind::InvalidInput => {
            Fault::new(FaultKind::Unsuitable, device, format!("{error}; is {baud} baud possible?"))
        }
        _ => Fault::new(FaultKind::Failed, device, format!("cannot be opened as a serial line: {error}")),
    }
}
