//! SBG Systems' sentences, and those of iXblue that they send: attitude (`$PSBGA`, `$PSBGB`, `$PHTRO`), rates and forces
//! (`$PSBGI`). Axes are forward, right, down; headings are true. Source: SBG's description of its NMEA messages
//! (`sbgECom`, doc/nmeaMessages.md).
//!
//! | sentence | used | states that exclude a value |
//! |---|---|---|
//! | `PSBGI` | rates, °/s, and specific forces, m/s², as measured | |
//! | `PSBGA` | roll, pitch, heading | `i` of each; solution `a` (none), `b` (no heading) |
//! | `PSBGB` | roll, pitch, heading, rates | 0 of each |
//! | `PHTRO` | pitch (M bow up, P bow down), roll (T port side up, B port side down) | |

use nalgebra::Vector3;

use super::fields::{heading, optional, tilt};
use super::reading::CompassReading;
use crate::counts::{DecodeCounts, Refusal};
use crate::sentence::Sentence;
use windhover_base::msg::InertialSample;

/// Largest rate, °/s, and force, m/s², that these sentences can have.
const RATE_MAX_DPS: f64 = 999.999;
const FORCE_MAX: f64 = 999.999;

/// Places of the angles in a sentence, and of the states of the tilt and of the heading.
struct Places {
    roll: usize,
    pitch: usize,
    heading: usize,
    tilt_state: usize,
    heading_state: usize,
}

const PSBGA: Places = Places { roll: 3, pitch: 4, heading: 5, tilt_state: 10, heading_state: 11 };
const PSBGB: Places = Places { roll: 4, pitch: 5, heading: 6, tilt_state: 10, heading_state: 11 };

/// The reading of such a sentence; `None` for other sentences.
pub(super) fn read(
    sentence: &Sentence<'_>,
    counts: &mut DecodeCounts,
) -> Result<Option<CompassReading>, Refusal> {
    match sentence.address() {
        "PSBGI" => inertial(sentence).map(Some),
        "PSBGA" => {
            let solution = sentence.field(9).to_ascii_lowercase();
            let mut reading = attitude(sentence, &PSBGA)?;
            if solution == "a" {
                (reading.pitch_deg, reading.roll_deg) = (None, None);
            }
            if matches!(solution.as_str(), "a" | "b") {
                (reading.heading_deg, reading.flagged) = (None, true);
            }
            Ok(Some(reading))
        }
        "PSBGB" => {
            let rate_rps = optional(counts, "rates", vector(sentence, 15, RATE_MAX_DPS)).map(to_radians);
            let inertial = rate_rps.map(|rate| InertialSample { rate_rps: Some(rate), force_mps2: None });
            Ok(Some(CompassReading { inertial, ..attitude(sentence, &PSBGB)? }))
        }
        "PHTRO" => ship_tilt(sentence).map(Some),
        _ => Ok(None),
    }
}

/// Whether a sentence has a part of an attitude that others complete.
pub(super) fn is_part(sentence: &Sentence<'_>) -> bool {
    sentence.address() == "PHTRO"
}

fn attitude(sentence: &Sentence<'_>, at: &Places) -> Result<CompassReading, Refusal> {
    if sentence.fields() < at.heading_state {
        return Err(Refusal::Malformed);
    }
    let is_valid = |state: usize| !matches!(sentence.field(state), "i" | "I" | "0");
    let (tilt_valid, heading_valid) = (is_valid(at.tilt_state), is_valid(at.heading_state));
    let heading_deg = heading(sentence.field(at.heading))?.filter(|_| heading_valid);
    Ok(CompassReading {
        heading_deg,
        heading_is_true: true,
        pitch_deg: tilt(sentence.field(at.pitch))?.filter(|_| tilt_valid),
        roll_deg: tilt(sentence.field(at.roll))?.filter(|_| tilt_valid),
        flagged: heading_deg.is_none() || !tilt_valid,
        ..CompassReading::default()
    })
}

fn inertial(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    let rate_rps = vector(sentence, 2, RATE_MAX_DPS)?.map(to_radians);
    let force_mps2 = vector(sentence, 5, FORCE_MAX)?;
    if rate_rps.is_none() && force_mps2.is_none() {
        return Err(Refusal::Malformed);
    }
    Ok(CompassReading {
        inertial: Some(InertialSample { rate_rps, force_mps2 }),
        ..CompassReading::default()
    })
}

/// Three numbers from a field on; `None` where one is not given.
fn vector(sentence: &Sentence<'_>, first: usize, most: f64) -> Result<Option<Vector3<f64>>, Refusal> {
    let axis = |index| sentence.number(first + index, -most, most);
    Ok(match (axis(0)?, axis(1)?, axis(2)?) {
        (Some(x), Some(y), Some(z)) => Some(Vector3::new(x, y, z)),
        _ => None,
    })
}

fn to_radians(degrees: Vector3<f64>) -> Vector3<f64> {
    degrees.map(f64::to_radians)
}

/// Sizes of pitch and roll, each with the letter of its sign.
fn ship_tilt(sentence: &Sentence<'_>) -> Result<CompassReading, Refusal> {
    let signed = |at: usize, up: &str, down: &str| {
        let size = sentence.number(at, 0.0, 180.0)?;
        match sentence.field(at + 1) {
            letter if letter == up => Ok(size),
            letter if letter == down => Ok(size.map(|size| -size)),
            _ => Err(Refusal::Malformed),
        }
    };
    let (pitch_deg, roll_deg) = (signed(1, "M", "P")?, signed(3, "T", "B")?);
    Ok(CompassReading { pitch_deg, roll_deg, ..CompassReading::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(body: &str) -> Result<CompassReading, Refusal> {
        read(&Sentence { body }, &mut DecodeCounts::default()).map(|reading| reading.expect("one of SBG's"))
    }

    #[test]
    fn the_sentences_of_the_manual() {
        let inertial = said("PSBGI,003944.74,-0.08,0.07,0.00,-0.02,0.06,-9.72,").map(|r| r.inertial);
        let inertial = inertial.expect("sound").expect("has rates");
        let rate = inertial.rate_rps.expect("given").map(f64::to_degrees);
        assert!((rate - Vector3::new(-0.08, 0.07, 0.0)).norm() < 1e-12, "{rate}");
        assert_eq!(inertial.force_mps2, Some(Vector3::new(-0.02, 0.06, -9.72)));

        let ekf = said("PSBGA,155513.685,V,13.684,-63.139,269.130,0.024,0.006,0.196,p,v,v").expect("sound");
        assert_eq!(
            (ekf.heading_deg, ekf.pitch_deg, ekf.roll_deg),
            (Some(269.13), Some(-63.139), Some(13.684))
        );
        assert!(ekf.heading_is_true && ekf.is_valid());

        let all = "PSBGB,1,000344.000,0,3.529,-12.821,6.122,0.101,0.098,10.117,1,2,0.004,0.050,2,0.772,0.004,-0.017,\
                   1.043,4.476,0.171,866.025,0,";
        let all = said(all).expect("sound");
        assert_eq!((all.heading_deg, all.pitch_deg, all.roll_deg), (Some(6.122), Some(-12.821), Some(3.529)));
        let rate = all.inertial.and_then(|inertial| inertial.rate_rps).expect("given").map(f64::to_degrees);
        assert!((rate - Vector3::new(0.772, 0.004, -0.017)).norm() < 1e-12, "{rate}");

        let tilt = said("PHTRO,0.03,P,0.22,T").expect("sound");
        assert_eq!((tilt.pitch_deg, tilt.roll_deg), (Some(-0.03), Some(0.22)));
        let tilt = said("PHTRO,0.03,M,0.22,B").expect("sound");
        assert_eq!((tilt.pitch_deg, tilt.roll_deg), (Some(0.03), Some(-0.22)));
    }

    #[test]
    fn states_exclude_their_values() {
        let ekf = |solution: &str, tilt: &str, heading: &str| {
            let body = format!("PSBGA,155513.685,V,1.0,2.0,30.0,0.1,0.1,0.1,{solution},{tilt},{heading}");
            let r = said(&body).expect("sound");
            (r.heading_deg, r.pitch_deg, r.roll_deg, r.is_valid())
        };
        assert_eq!(ekf("C", "v", "v"), (Some(30.0), Some(2.0), Some(1.0), true));
        assert_eq!(ekf("C", "v", "i"), (None, Some(2.0), Some(1.0), false));
        assert_eq!(ekf("C", "i", "v"), (Some(30.0), None, None, false));
        assert_eq!(ekf("b", "v", "v"), (None, Some(2.0), Some(1.0), false));
        assert_eq!(ekf("a", "v", "v"), (None, None, None, false));
        let invalid =
            said("PSBGB,1,000344.000,0,3.5,-12.8,6.1,0.1,0.1,10.1,0,0,0.0,0.05,2,,,,,,,,0,").expect("sound");
        assert_eq!((invalid.heading_deg, invalid.pitch_deg, invalid.inertial), (None, None, None));
    }

    #[test]
    fn damage_is_refused() {
        for body in [
            "PSBGI,003944.74,,,,,,,",
            "PSBGI,003944.74,-0.08,0.07,abc,-0.02,0.06,-9.72,",
            "PSBGI,003944.74,-0.08,0.07,0.0,-0.02,0.06,-9720,",
            "PSBGA,155513.685,V,13.684,-63.139",
            "PSBGA,155513.685,V,13.684,-63.139,400,0.024,0.006,0.196,p,v,v",
            "PHTRO,0.03,X,0.22,T",
            "PHTRO,-0.03,P,0.22,T",
        ] {
            assert!(said(body).is_err(), "{body}");
        }
    }
}
