//! Brings a Garmin receiver to the line speed of the configuration: finds its present speed, sends the configured one,
//! restarts it. A receiver in binary mode answers no sentence: it is switched to NMEA first.
//!
//! Source: Garmin GPS 18x technical specifications, "Sensor Configuration Information (PGRMC)": field 10 is
//! the line speed, which takes effect after a reset (`PGRMI`, field 7 = R).

use std::borrow::Cow;

use super::dialogue::Dialogue;
use super::garmin::{bodies, sentence};
use crate::io::device::Fault;

/// Speeds that a receiver may have and their codes in PGRMC, factory settings first.
const SPEEDS: [(u32, u8); 4] = [(19_200, 5), (4_800, 3), (38_400, 8), (9_600, 4)];

/// Queries the present configuration: a receiver also answers when all its sentences are off.
const QUERY: &str = "PGRMCE";

/// Ends the binary mode: Garmin's packet 10 (line command) that requests NMEA, with its frame bytes.
const SPEAK_NMEA: [u8; 8] = [0x10, 0x0A, 0x02, 0x26, 0x00, 0xCE, 0x10, 0x03];

/// Restarts the receiver.
const RESET: &str = "PGRMI,,,,,,,R";

/// Sets the line, and where possible the receiver, to the configured speed.
pub(super) async fn settle(mut talk: Dialogue<'_>) -> Result<(), Fault> {
    let wanted = talk.settings.baud;
    if speaks(&mut talk).await? {
        return Ok(());
    }
    let Some(code) = SPEEDS.iter().find(|(speed, _)| *speed == wanted).map(|(_, code)| *code) else {
        return Ok(());
    };
    for (speed, _) in SPEEDS.iter().filter(|(speed, _)| *speed != wanted) {
        talk.line.set_speed(*speed).await?;
        if !speaks(&mut talk).await? {
            continue;
        }
        send(&mut talk, &format!("PGRMC,,,,,,,,,,{code}")).await?;
        let received = talk.listen(|bytes| answered(&text(bytes), code)).await?;
        send(&mut talk, RESET).await?;
        // The echo still has the old speed; the new one takes effect after the reset.
        talk.listen(|bytes| bodies(&text(bytes)).any(|body| body.starts_with("PGRMI"))).await?;
        talk.note(received, format!("the receiver used {speed} baud and was set to {wanted}"));
        break;
    }
    talk.line.set_speed(wanted).await
}

/// Whether sentences arrive at the line's present speed, also after leaving binary mode.
async fn speaks(talk: &mut Dialogue<'_>) -> Result<bool, Fault> {
    send(talk, QUERY).await?;
    if talk.listen(|bytes| holds_a_sentence(&text(bytes))).await? {
        return Ok(true);
    }
    talk.send(&SPEAK_NMEA).await?;
    send(talk, QUERY).await?;
    let speaks = talk.listen(|bytes| holds_a_sentence(&text(bytes))).await?;
    if speaks {
        talk.note(true, "the receiver was in binary mode and was switched to NMEA".to_owned());
    }
    Ok(speaks)
}

async fn send(talk: &mut Dialogue<'_>, body: &str) -> Result<(), Fault> {
    talk.send(sentence(body).as_bytes()).await
}

fn text(bytes: &[u8]) -> Cow<'_, str> {
    String::from_utf8_lossy(bytes)
}

fn holds_a_sentence(text: &str) -> bool {
    bodies(text).next().is_some()
}

/// Whether the receiver echoed the new speed.
fn answered(text: &str, code: u8) -> bool {
    bodies(text).any(|body| {
        body.starts_with("PGRMC,") && body.split(',').nth(10).is_some_and(|field| field == code.to_string())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences_are_distinguished_from_noise() {
        assert!(holds_a_sentence(&format!("\u{fffd}x${}", sentence("GPRMC,1").trim_start_matches('$'))));
        assert!(!holds_a_sentence("$GPRMC,1*00\r\n$GP"));
        assert!(answered(&sentence("PGRMC,A,,100,,,,,,A,8,,2,4,"), 8));
        assert!(!answered(&sentence("PGRMC,A,,100,,,,,,A,5,,2,4,"), 8));
    }
}
