//! Damaged pictures: every pixel that is shown is as the camera took it.

use std::collections::HashSet;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::huffman::{STANDARD_TABLES, Writer, standard};
use super::{MissingPart, decode};
use windhover_base::msg::{FrameEncoding, FramePayload, GrayImage};
use windhover_base::time::MonoTime;

/// Blocks across and down of the pictures here.
const BLOCKS: (usize, usize) = (20, 12);

/// A grey picture of random blocks; the start of its scan and of each of its parts.
struct Picture {
    bytes: Vec<u8>,
    scan: usize,
    parts: Vec<usize>,
}

impl Picture {
    /// With a restart after this many blocks (0: none), with Huffman tables or without.
    fn new(seed: u64, restart: usize, with_tables: bool) -> Self {
        let (width, height) = ((BLOCKS.0 * 8) as u8, (BLOCKS.1 * 8) as u8);
        let mut bytes = vec![0xFF, 0xD8, 0xFF, 0xDB, 0, 67, 0];
        bytes.extend_from_slice(&[8; 64]);
        bytes.extend_from_slice(&[0xFF, 0xC0, 0, 11, 8, 0, height, 0, width, 1, 1, 0x11, 0]);
        if with_tables {
            bytes.extend_from_slice(STANDARD_TABLES);
        }
        if restart > 0 {
            bytes.extend_from_slice(&[0xFF, 0xDD, 0, 4, 0, restart as u8]);
        }
        bytes.extend_from_slice(&[0xFF, 0xDA, 0, 8, 1, 1, 0, 0, 63, 0]);
        let scan = bytes.len();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let all = BLOCKS.0 * BLOCKS.1;
        let length = if restart == 0 { all } else { restart };
        let mut parts = Vec::new();
        for (index, first) in (0..all).step_by(length).enumerate() {
            if index > 0 {
                bytes.extend_from_slice(&[0xFF, 0xD0 + ((index - 1) % 8) as u8]);
            }
            parts.push(bytes.len());
            random_blocks(length.min(all - first), &mut rng, &mut bytes);
        }
        bytes.extend_from_slice(&[0xFF, 0xD9]);
        Self { bytes, scan, parts }
    }
}

fn random_blocks(count: usize, rng: &mut ChaCha8Rng, out: &mut Vec<u8>) {
    let [dc, _, ac, _] = standard();
    let mut writer = Writer::new(out);
    let mut level = 0i32;
    for _ in 0..count {
        let next = rng.random_range(-100..100);
        write_value(&mut writer, 0, next - level, |symbol| dc.of(symbol));
        level = next;
        for _ in 0..rng.random_range(4..14) {
            let value = rng.random_range(1..12) * if rng.random_bool(0.5) { 1 } else { -1 };
            write_value(&mut writer, rng.random_range(0..3) << 4, value, |symbol| ac.of(symbol));
        }
        writer.write(ac.of(0).expect("the end of a block"));
    }
    writer.finish();
}

/// A code for the value's size together with `high_bits`, and the value's bits.
fn write_value(writer: &mut Writer<'_>, high_bits: u8, value: i32, code: impl Fn(u8) -> Option<(u32, u32)>) {
    let size = 32 - value.unsigned_abs().leading_zeros();
    writer.write(code(high_bits | size as u8).expect("in the standard's table"));
    if size > 0 {
        let bits = if value < 0 { value - 1 + (1 << size) } else { value };
        writer.write((bits as u32, size));
    }
}

fn shown(bytes: &[u8]) -> Result<(GrayImage, Vec<MissingPart>), String> {
    let frame = FramePayload {
        index: 0,
        t_exposure: MonoTime::default(),
        encoding: FrameEncoding::Jpeg,
        width: 0,
        height: 0,
        stride: 0,
        data: bytes.into(),
    };
    decode(&frame, false).map(|frame| (frame.gray, frame.missing)).map_err(|fault| fault.to_string())
}

/// Numbers of the missing blocks; the others must be those of the original picture.
fn missing_blocks(
    shown: &(GrayImage, Vec<MissingPart>),
    whole: &GrayImage,
) -> Result<HashSet<usize>, String> {
    let (image, parts) = shown;
    let lost =
        |u, v| parts.iter().any(|p| (p.from.0..p.to.0).contains(&u) && (p.from.1..p.to.1).contains(&v));
    let mut missing = HashSet::new();
    for (v, (row, wanted)) in image.data.chunks(image.width).zip(whole.data.chunks(image.width)).enumerate() {
        for (u, (level, wanted)) in row.iter().zip(wanted).enumerate() {
            if lost(u, v) {
                missing.insert(v / 8 * BLOCKS.0 + u / 8);
            } else if level != wanted {
                return Err(format!("({u}, {v}) is {level}, was {wanted}"));
            }
        }
    }
    Ok(missing)
}

#[test]
fn a_whole_picture_is_whole() {
    for restart in [0, 1, 7, 20, 240] {
        let picture = Picture::new(1, restart, true);
        let (image, missing) = shown(&picture.bytes).expect("whole");
        assert_eq!((image.width, image.height, missing), (BLOCKS.0 * 8, BLOCKS.1 * 8, Vec::new()));
        // Zeros after the last block are the padding of some cameras.
        let mut filled = picture.bytes.clone();
        let end = filled.len() - 2;
        filled.splice(end..end, [0; 5]);
        assert_eq!(shown(&filled).expect("whole").0, image);
    }
}

#[test]
fn without_tables_the_standard_ones_hold() {
    for restart in [0, 9] {
        let (bare, full) = (Picture::new(2, restart, false), Picture::new(2, restart, true));
        assert_eq!(shown(&bare.bytes), shown(&full.bytes));
    }
}

#[test]
fn without_restarts_a_loss_makes_the_picture_unusable() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let picture = Picture::new(3, 0, true);
    for _ in 0..300 {
        let length = rng.random_range(1..1_500.min(picture.bytes.len() - picture.scan - 2));
        let at = rng.random_range(picture.scan..picture.bytes.len() - 2 - length);
        let mut cut = picture.bytes.clone();
        cut.drain(at..at + length);
        assert!(shown(&cut).is_err(), "{length} bytes lost at {at}");
    }
    for length in picture.scan..picture.bytes.len() - 3 {
        assert!(shown(&picture.bytes[..length]).is_err(), "cut at {length}");
    }
}

#[test]
fn with_restarts_what_is_whole_stands_where_it_belongs() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let (mut used, mut close) = (0, 0);
    for case in 0..300 {
        let restart = [4, 6, 10, 20][case % 4];
        let picture = Picture::new(case as u64, restart, true);
        let (whole, _) = shown(&picture.bytes).expect("whole");
        // Lost: bytes within a part, a part with its marker, or several parts.
        let length = [17, 60, 188, 900][rng.random_range(0..4)].min(picture.bytes.len() - picture.scan - 2);
        let at = rng.random_range(picture.scan..picture.bytes.len() - 1 - length);
        let hit = picture.parts.iter().filter(|part| **part < at + length).count()
            - picture.parts.iter().filter(|part| **part <= at).count();
        let mut cut = picture.bytes.clone();
        cut.drain(at..at + length);
        match shown(&cut) {
            Ok(seen) => {
                let missing =
                    missing_blocks(&seen, &whole).unwrap_or_else(|why| panic!("case {case}: {why}"));
                // Usually the affected parts, and one more where a cut ends a part that another began.
                close += usize::from(missing.len() <= (hit + 2) * restart);
                used += 1;
            }
            Err(why) => assert!(!why.is_empty()),
        }
    }
    assert!(used > 200 && close * 10 > used * 9, "{used} used, {close} with little missing");
}

#[test]
fn a_lost_interval_is_known_by_the_numbers() {
    let picture = Picture::new(5, 10, true);
    let (whole, _) = shown(&picture.bytes).expect("whole");
    for lost in 1..picture.parts.len() - 1 {
        for count in 1..(picture.parts.len() - 1 - lost).min(10) {
            let mut cut = picture.bytes.clone();
            cut.drain(picture.parts[lost]..picture.parts[lost + count]);
            let seen = shown(&cut);
            if count == 8 {
                assert!(seen.is_err(), "eight are only visible in the total number");
                continue;
            }
            let missing =
                missing_blocks(&seen.expect("most of it is present"), &whole).expect("in its place");
            // And the single interval between their numbers: it may be the first or the last.
            assert_eq!(missing.len(), 10 * (count + 1), "{count} from {lost}");
        }
    }
}

#[test]
fn any_damage_is_survived() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for case in 0..2_000 {
        let picture = Picture::new(case % 5, [0, 5, 20][case as usize % 3], case % 2 == 0);
        let mut bytes = picture.bytes;
        for _ in 0..rng.random_range(1..6) {
            let at = rng.random_range(0..bytes.len());
            bytes[at] = rng.random();
        }
        bytes.truncate(rng.random_range(1..bytes.len() + 1));
        if let Ok((image, _)) = shown(&bytes) {
            assert_eq!(image.data.len(), image.width * image.height);
        }
    }
}
