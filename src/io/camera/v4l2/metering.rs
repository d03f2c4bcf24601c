//! Automatic exposure that is never longer than a limit: exposure and gain from the light of the frames.
//!
//! V4L2 has no control for the longest automatic exposure, and cameras lengthen exposure before they raise gain. This one
//! lengthens exposure up to its limit and then raises the gain; in more light it does the reverse.

use super::node::Limits;
use windhover_base::msg::GrayImage;

/// Mean grey level that is aimed at. White print beside dark ground is then not saturated.
const AIM: f64 = 100.0;

/// Grey level from which a pixel counts as saturated.
const SATURATED: u8 = 250;

/// Share of saturated pixels above which the picture is made darker, and below which it may be made brighter.
const MOST_SATURATED: f64 = 0.03;
const FEW_SATURATED: f64 = 0.005;

/// Deviations of the light below this are left, octaves: exposure and gain then stay still.
const DEAD_OCTAVES: f64 = 0.2;

/// Largest step, octaves.
const STEP_OCTAVES: f64 = 1.0;

/// Part of the gain's range that changes for a step of an octave, at first. The unit of gain differs among drivers: where a
/// step was too large (the next one goes back), the following one is half as large.
const GAIN_SHARE: f64 = 0.1;
const LEAST_GAIN_SHARE: f64 = 0.005;

/// Distance of the pixels that are looked at, in both directions.
const GRID: usize = 8;

/// The light of a frame.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Light {
    /// Mean grey level.
    pub(super) mean: f64,
    /// Share of saturated pixels.
    pub(super) saturated: f64,
}

impl Light {
    /// The light of a picture; `None` of an empty one.
    pub(super) fn of(picture: &GrayImage) -> Option<Self> {
        let rows = picture.data.chunks(picture.stride.max(1)).take(picture.height).step_by(GRID);
        let (mut count, mut sum, mut saturated) = (0_u32, 0_u64, 0_u32);
        for &level in rows.flat_map(|row| row.iter().take(picture.width).step_by(GRID)) {
            count += 1;
            sum += u64::from(level);
            saturated += u32::from(level >= SATURATED);
        }
        let part = |figure: f64| figure / f64::from(count);
        (count > 0).then(|| Self { mean: part(sum as f64), saturated: part(f64::from(saturated)) })
    }

    /// By how much the picture should be brighter, octaves.
    fn missing_octaves(self) -> f64 {
        let octaves = (AIM / self.mean.max(1.0)).log2().clamp(-STEP_OCTAVES, STEP_OCTAVES);
        if self.saturated > MOST_SATURATED {
            octaves.min(-STEP_OCTAVES / 2.0)
        } else if self.saturated > FEW_SATURATED {
            octaves.min(0.0)
        } else {
            octaves
        }
    }
}

/// Exposure (100 µs) and gain of a camera.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Setting {
    pub(super) exposure: i32,
    /// `None` where the gain is fixed or the camera has none.
    pub(super) gain: Option<i32>,
}

/// The automatic exposure.
#[derive(Clone, Debug)]
pub(super) struct Metering {
    /// Of the exposure; the longest is the configured limit.
    exposure: Limits,
    /// Of the gain, where it is to be set.
    gain: Option<Limits>,
    now: Setting,
    gain_share: f64,
    rose: Option<bool>,
}

impl Metering {
    /// Begins with a setting of the camera.
    pub(super) const fn new(exposure: Limits, gain: Option<Limits>, now: Setting) -> Self {
        Self { exposure, gain, now, gain_share: GAIN_SHARE, rose: None }
    }

    /// The setting after a frame of this light; `None` where it stays.
    pub(super) fn step(&mut self, light: Light) -> Option<Setting> {
        let octaves = light.missing_octaves();
        if octaves.abs() < DEAD_OCTAVES {
            return None;
        }
        let before = self.now;
        if octaves > 0.0 {
            self.expose(octaves);
            if before.exposure >= self.exposure.most {
                self.amplify(octaves);
            }
        } else {
            self.amplify(octaves);
            if self.now == before {
                self.expose(octaves);
            }
        }
        (self.now != before).then_some(self.now)
    }

    fn expose(&mut self, octaves: f64) {
        self.now.exposure = self.exposure.nearest(f64::from(self.now.exposure) * octaves.exp2());
    }

    fn amplify(&mut self, octaves: f64) {
        let Some((limits, gain)) = self.gain.zip(self.now.gain) else { return };
        let range = f64::from(limits.most) - f64::from(limits.least);
        let changed = limits.nearest(f64::from(gain) + self.gain_share * octaves * range);
        if changed == gain {
            return;
        }
        let rises = changed > gain;
        let goes_back = self.rose.replace(rises).is_some_and(|rose| rose != rises);
        self.gain_share *= if goes_back { 0.5 } else { 1.5 };
        self.gain_share = self.gain_share.clamp(LEAST_GAIN_SHARE, GAIN_SHARE);
        self.now.gain = Some(changed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXPOSURE: Limits = Limits { least: 1, most: 20, step: 1 };
    const GAIN: Limits = Limits { least: 0, most: 255, step: 1 };

    /// A camera that sees a scene of this brightness: levels of one exposure unit at gain 1, with white print that is three
    /// times as bright on a share of it.
    struct Camera {
        brightness: f64,
        white: f64,
        gamma: f64,
        gain: fn(i32) -> f64,
    }

    impl Camera {
        fn sees(&self, setting: Setting) -> Light {
            let light = self.brightness * f64::from(setting.exposure) * setting.gain.map_or(1.0, self.gain);
            let level = |light: f64| 255.0 * (light / 255.0).min(1.0).powf(1.0 / self.gamma);
            let (ground, print) = (level(light), level(3.0 * light));
            let share = |level: f64, part: f64| if level >= 250.0 { part } else { 0.0 };
            let mean = ground * (1.0 - self.white) + print * self.white;
            Light { mean, saturated: share(ground, 1.0 - self.white) + share(print, self.white) }
        }

        /// The settings of fifty measurements from the longest exposure on.
        fn follow(&self, metering: &mut Metering) -> Vec<Setting> {
            let next = |metering: &mut Metering| {
                let light = self.sees(metering.now);
                metering.step(light);
                metering.now
            };
            (0..50).map(|_| next(metering)).collect()
        }
    }

    fn linear(gain: i32) -> f64 {
        1.0 + 31.0 * f64::from(gain) / 255.0
    }

    fn logarithmic(gain: i32) -> f64 {
        (5.0 * f64::from(gain) / 255.0).exp2()
    }

    #[test]
    fn light_of_every_strength_is_settled_on_and_the_limit_holds() {
        for gain in [linear, logarithmic] {
            for gamma in [1.0, 2.2] {
                for brightness in [0.5, 2.0, 10.0, 60.0] {
                    let camera = Camera { brightness, white: 0.02, gamma, gain };
                    let begin = Setting { exposure: 20, gain: Some(0) };
                    let mut metering = Metering::new(EXPOSURE, Some(GAIN), begin);
                    let settings = camera.follow(&mut metering);
                    assert!(settings.iter().all(|setting| (1..=20).contains(&setting.exposure)));
                    let about = format!("brightness {brightness}, gamma {gamma}: {settings:?}");
                    assert!(settings[40..].windows(2).all(|w| w[0] == w[1]), "does not settle: {about}");
                    let mean = camera.sees(settings[49]).mean;
                    assert!((70.0..140.0).contains(&mean), "mean {mean}: {about}");
                }
            }
        }
    }

    #[test]
    fn gain_rises_only_at_the_longest_exposure_and_falls_first() {
        let dark = Light { mean: 20.0, saturated: 0.0 };
        let bright = Light { mean: 220.0, saturated: 0.0 };
        let mut metering = Metering::new(EXPOSURE, Some(GAIN), Setting { exposure: 10, gain: Some(0) });
        assert_eq!(metering.step(dark), Some(Setting { exposure: 20, gain: Some(0) }));
        let raised = metering.step(dark).expect("the gain rises");
        assert!(raised.exposure == 20 && raised.gain > Some(0), "{raised:?}");
        let lowered = metering.step(bright).expect("the gain falls");
        assert!(lowered.exposure == 20 && lowered.gain < raised.gain, "{lowered:?}");
    }

    #[test]
    fn saturated_print_counts_before_dark_ground() {
        let mut metering = Metering::new(EXPOSURE, None, Setting { exposure: 10, gain: None });
        let darker = metering.step(Light { mean: 40.0, saturated: 0.1 }).expect("darker");
        assert!(darker.exposure < 10, "{darker:?}");
        assert_eq!(metering.step(Light { mean: 40.0, saturated: 0.01 }), None);
    }

    #[test]
    fn light_is_measured_on_a_grid() {
        let mut picture = GrayImage { width: 64, height: 32, stride: 64, data: vec![100; 64 * 32] };
        picture.data[..64 * 8].fill(255);
        let light = Light::of(&picture).expect("not empty");
        assert_eq!((light.mean, light.saturated), (138.75, 0.25));
        assert_eq!(Light::of(&GrayImage::default()), None);
    }
}
