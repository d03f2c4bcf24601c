//! Brings a u-blox receiver to the line speed of the configuration: finds its present speed and sends the configured
//! one.
//!
//! Over USB any speed is the right one. Source: u-blox's interface descriptions (UBX-CFG-VALSET from the ninth
//! generation on, UBX-CFG-PRT for older ones).

use super::dialogue::Dialogue;
use super::garmin::bodies;
use crate::io::device::Fault;
use windhover_decode::{ubx_framed, ubx_packets};

/// Speeds that a receiver may have, factory settings first.
const SPEEDS: [u32; 8] = [9_600, 38_400, 115_200, 57_600, 230_400, 460_800, 921_600, 19_200];
/// Class of acknowledgements.
const ACK: u8 = 0x05;
/// Queries the version: a receiver also answers when all its output is off.
const MON_VER: (u8, u8) = (0x0A, 0x04);
/// Key of the first serial port's speed.
const KEY_UART1_BAUDRATE: u32 = 0x4052_0001;

/// Sets the line, and where possible the receiver, to the configured speed.
pub(super) async fn settle(mut talk: Dialogue<'_>) -> Result<(), Fault> {
    let wanted = talk.settings.baud;
    if speaks(&mut talk).await? {
        return Ok(());
    }
    for speed in SPEEDS.into_iter().filter(|speed| *speed != wanted) {
        talk.line.set_speed(speed).await?;
        if !speaks(&mut talk).await? {
            continue;
        }
        let mut is_done = false;
        for packet in [by_key(wanted), by_port(wanted)] {
            talk.line.set_speed(speed).await?;
            talk.send(&packet).await?;
            // Its acknowledgement may come at either speed.
            talk.listen(|bytes| ubx_packets(bytes).any(|(class, ..)| class == ACK)).await?;
            talk.line.set_speed(wanted).await?;
            is_done = speaks(&mut talk).await?;
            if is_done {
                break;
            }
        }
        talk.note(is_done, format!("the receiver used {speed} baud and was set to {wanted}"));
        break;
    }
    talk.line.set_speed(wanted).await
}

/// Whether a valid packet or sentence arrives at the line's present speed.
async fn speaks(talk: &mut Dialogue<'_>) -> Result<bool, Fault> {
    talk.send(&ubx_framed(MON_VER.0, MON_VER.1, &[])).await?;
    talk.listen(|bytes| {
        ubx_packets(bytes).next().is_some() || bodies(&String::from_utf8_lossy(bytes)).next().is_some()
    })
    .await
}

fn by_key(baud: u32) -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    payload.extend_from_slice(&KEY_UART1_BAUDRATE.to_le_bytes());
    payload.extend_from_slice(&baud.to_le_bytes());
    ubx_framed(0x06, 0x8A, &payload)
}

/// The first serial port: 8N1, all protocols in, UBX and sentences out.
fn by_port(baud: u32) -> Vec<u8> {
    let mut payload = vec![1, 0, 0, 0];
    payload.extend_from_slice(&0x8D0u32.to_le_bytes());
    payload.extend_from_slice(&baud.to_le_bytes());
    payload.extend_from_slice(&[7, 0, 3, 0, 0, 0, 0, 0]);
    ubx_framed(0x06, 0x00, &payload)
}
