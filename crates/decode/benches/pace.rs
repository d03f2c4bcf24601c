//! Cost of decoding: 200 kB/s of mixed bytes on a line, as a share of a core. The limit is 5 %.
//!
//! `cargo bench -p windhover-decode --bench pace`

use std::time::Instant;

use windhover_base::settings::{CompassFormat, GpsFormat};
use windhover_base::time::{MonoTime, Span};
use windhover_decode::{CompassDecoder, GnssDecoder, framed, ubx_framed};

/// Bytes of a second.
const PACE: usize = 200_000;
/// Seconds decoded; the least of five runs counts.
const SECONDS: usize = 20;

/// Sentences, packets and noise in turn, of this many bytes; the same ones in every run.
fn mixed(pieces: &[Vec<u8>], bytes: usize) -> Vec<u8> {
    let (mut out, mut dice) = (Vec::with_capacity(bytes), 0x9E37_79B9u32);
    for n in 0.. {
        if out.len() >= bytes {
            break;
        }
        dice ^= dice << 13;
        dice ^= dice >> 17;
        dice ^= dice << 5;
        // One piece in sixteen is damaged, one in thirty-two is noise.
        let mut piece = pieces[n % pieces.len()].clone();
        if dice.is_multiple_of(16) {
            let at = dice as usize / 16 % piece.len();
            piece[at] ^= 0x5A;
        }
        if dice.is_multiple_of(32) {
            piece.extend((0..60u32).map(|i| (dice.rotate_left(i) >> 3) as u8));
        }
        out.extend(piece);
    }
    out.truncate(bytes);
    out
}

fn sentences(bodies: &[&str]) -> Vec<Vec<u8>> {
    bodies.iter().map(|body| (framed(body) + "\r\n").into_bytes()).collect()
}

/// Share of a core, percent, for decoding these bytes in the reads of a serial line.
fn share(bytes: &[u8], mut decode: impl FnMut(&[u8], MonoTime)) -> f64 {
    let run = |decode: &mut dyn FnMut(&[u8], MonoTime)| {
        let (began, mut t) = (Instant::now(), MonoTime::from_ns(1_795_014_245_000_000_000));
        for read in bytes.chunks(61) {
            t += Span::from_s(read.len() as f64 / PACE as f64);
            decode(read, t);
        }
        began.elapsed().as_secs_f64()
    };
    let least = (0..5).map(|_| run(&mut decode)).fold(f64::INFINITY, f64::min);
    100.0 * least / (bytes.len() as f64 / PACE as f64)
}

fn main() {
    let mut pieces = sentences(&[
        "GPRMC,150405.2,A,3004.17608,N,08534.52362,W,000.2,358.5,181126,003.4,W,D",
        "GPGGA,150405.2,3004.17608,N,08534.52362,W,2,09,0.9,33.1,M,-27.9,M,,",
        "GPGSA,A,3,04,05,,09,12,,,24,,,,,2.5,1.3,2.1",
        "GPGSV,3,1,11,03,03,111,00,04,15,270,00,06,01,010,00,13,06,292,00",
        "GNGST,150405.2,1.2,1.5,0.9,30,0.8,0.9,1.7",
        "PGRME,4.3,M,6.1,M,7.5,M",
        "PGRMV,-2.5,-1.1,0.3",
    ]);
    pieces.extend([
        ubx_framed(1, 7, &[0; 92]),
        ubx_framed(1, 0x36, &[0; 64]),
        ubx_framed(2, 0x15, &[7; 300]),
    ]);
    let bytes = mixed(&pieces, SECONDS * PACE);
    for format in [GpsFormat::Auto, GpsFormat::Nmea, GpsFormat::Ubx] {
        let (mut decoder, mut out) = (GnssDecoder::new().of_format(format), Vec::new());
        let percent = share(&bytes, |read, t| {
            decoder.push(read, t, &mut out);
            decoder.tick(t, &mut out);
            out.clear();
        });
        println!("gps {format:?}: {percent:.2} %");
    }
    let mut pieces = sentences(&[
        "C328.3P28.4R-12.4X55.11Y12.33Z-18.43T22.3",
        "PTNTHPR,85.9,N,-0.9,N,0.8,N",
        "HCHDG,85.9,,,3.4,W",
        "HCXDR,A,-0.9,D,PITCH,A,0.8,D,ROLL",
        "VNYMR,+085.123,-000.900,+000.800,+01.06,-00.25,+03.06,+00.005,+00.344,-09.758,-0.001,+0.002,-0.003",
        "GNHPR,040400.00,201.75,+1.20,000.00,4,33,1.00,0004",
    ]);
    pieces.push(ubx_framed(1, 0x3C, &[1; 64]));
    pieces.push([0x55, 0x53, 1, 2, 3, 4, 5, 6, 7, 8, 0xCC].repeat(4));
    pieces.push([0x00, 0x05, 0x01, 0xEF, 0xD4].repeat(6));
    let bytes = mixed(&pieces, SECONDS * PACE);
    for format in CompassFormat::ALL {
        let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
        let percent = share(&bytes, |read, t| {
            decoder.push(read, t, &mut out);
            decoder.tick(t, &mut out);
            out.clear();
        });
        println!("compass {}: {percent:.2} %", format.name());
    }
}
