//! Properties of the compass decoders on arbitrary bytes.

use proptest::prelude::*;

use super::{CompassDecoder, ReceivedAttitude};
use crate::sentence::framed;
use windhover_base::settings::CompassFormat;
use windhover_base::time::MonoTime;

fn in_pieces(format: CompassFormat, bytes: &[u8], sizes: &[usize]) -> Vec<ReceivedAttitude> {
    let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
    let (mut rest, mut sizes) = (bytes, sizes.iter().cycle());
    while !rest.is_empty() {
        let (read, after) = rest.split_at((*sizes.next().expect("endless")).clamp(1, rest.len()));
        decoder.push(read, MonoTime::default(), &mut out);
        rest = after;
    }
    decoder.flush(&mut out);
    out
}

fn check(received: &[ReceivedAttitude]) -> Result<(), TestCaseError> {
    for ReceivedAttitude { reading, sample, .. } in received {
        prop_assert!(reading.heading_deg.is_none_or(|deg| (0.0..=360.0).contains(&deg)));
        let angles = [reading.pitch_deg, reading.roll_deg];
        prop_assert!(angles.iter().flatten().all(|deg| (-180.0..=180.0).contains(deg)));
        prop_assert_eq!(sample.tilt.is_some(), angles.iter().all(Option::is_some));
    }
    Ok(())
}

proptest! {
    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..2_000)) {
        for format in CompassFormat::ALL {
            check(&in_pieces(format, &bytes, &[usize::MAX]))?;
        }
    }

    #[test]
    fn sound_frames_of_any_fields_are_survived(
        bodies in prop::collection::vec(
            "(C[-.0-9CPRTXYZE]{0,20}|(PTNTHPR|PTNTHTM|PASHR|OHPR|HCHDG|HCHDT|HCXDR)(,[-.0-9A-Z]{0,6}){0,13})",
            0..30,
        ),
    ) {
        let text: String = bodies.iter().map(|body| framed(body) + "\r\n").collect();
        for format in CompassFormat::ALL {
            check(&in_pieces(format, text.as_bytes(), &[usize::MAX]))?;
        }
    }

    #[test]
    fn where_reads_cut_the_stream_changes_nothing(
        sizes in prop::collection::vec(1usize..30, 1..20),
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4),
    ) {
        let bodies =
            ["C12.5P1.0R-2.0E000", "C13.0P1.5R-2.5", "PTNTHPR,85.9,N,-0.9,M,0.8,O", "PTNTHTM,14223,N,169,N,-43,N,1,2"];
        let text: String = bodies.iter().map(|body| framed(body) + "\r\n").collect();
        let mut bytes = [text.as_bytes(), &[0, 5, 1, 0xEF, 0xD4, 0, 5, 4, 0xBF, 0x71]].concat();
        for (at, byte) in damage {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        for format in CompassFormat::ALL {
            let readings = |sizes: &[usize]| {
                in_pieces(format, &bytes, sizes).iter().map(|received| received.reading).collect::<Vec<_>>()
            };
            prop_assert_eq!(readings(&[usize::MAX]), readings(&sizes));
        }
    }
}
