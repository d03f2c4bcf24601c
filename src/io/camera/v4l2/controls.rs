//! Exposure and gain by V4L2's controls: what is set for a request, and what the camera lacks.

use v4l::v4l_sys::{
    V4L2_CID_ANALOGUE_GAIN, V4L2_CID_AUTOGAIN, V4L2_CID_EXPOSURE_ABSOLUTE, V4L2_CID_EXPOSURE_AUTO,
    V4L2_CID_EXPOSURE_AUTO_PRIORITY, V4L2_CID_GAIN,
};

use super::node::{Limits, Node};
use crate::io::camera::ExposureSettings;

/// Unit of [`Control::Exposure`], µs.
pub(super) const EXPOSURE_UNIT_US: f64 = 100.0;

/// The controls that are set.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Control {
    /// Who sets exposure and iris.
    AutoExposure,
    /// Whether automatic exposure may lower the frame rate.
    DynamicRate,
    /// Whether the camera sets its gain.
    AutoGain,
    /// Gain of the whole camera, in the driver's units.
    Gain,
    /// Gain of a sensor, where the camera has no [`Self::Gain`].
    AnalogueGain,
    /// Exposure in units of 100 µs.
    Exposure,
}

impl Control {
    /// Its number in `linux/v4l2-controls.h`.
    pub(super) const fn id(self) -> u32 {
        match self {
            Self::AutoExposure => V4L2_CID_EXPOSURE_AUTO,
            Self::DynamicRate => V4L2_CID_EXPOSURE_AUTO_PRIORITY,
            Self::AutoGain => V4L2_CID_AUTOGAIN,
            Self::Gain => V4L2_CID_GAIN,
            Self::AnalogueGain => V4L2_CID_ANALOGUE_GAIN,
            Self::Exposure => V4L2_CID_EXPOSURE_ABSOLUTE,
        }
    }

    /// Its name in `v4l2-ctl --list-ctrls`.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::AutoExposure => "auto_exposure",
            Self::DynamicRate => "exposure_dynamic_framerate",
            Self::AutoGain => "gain_automatic",
            Self::Gain => "gain",
            Self::AnalogueGain => "analogue_gain",
            Self::Exposure => "exposure_time_absolute",
        }
    }
}

/// `V4L2_EXPOSURE_MANUAL` of [`Control::AutoExposure`], and `V4L2_EXPOSURE_SHUTTER_PRIORITY` (the camera sets the iris only) for
/// cameras that have only this one.
const MANUAL: [i32; 2] = [1, 2];

/// Limits of the controls that a camera has.
pub(super) trait Has: Fn(Control) -> Option<Limits> {}
impl<F: Fn(Control) -> Option<Limits>> Has for F {}

/// What is to be set for a request.
#[derive(Clone, PartialEq, Debug, Default)]
pub(super) struct Plan {
    /// Controls and their values, in this order: a driver refuses a figure while the camera sets it by itself.
    pub(super) sets: Vec<(Control, i32)>,
    /// What cannot be done, in words for the operator.
    pub(super) lacks: Vec<String>,
}

/// The gain that a camera has: its control and limits.
pub(super) fn gain_of(has: &impl Has) -> Option<(Control, Limits)> {
    [Control::Gain, Control::AnalogueGain].into_iter().find_map(|control| Some((control, has(control)?)))
}

/// The longest exposure that a camera takes within `max_us`; its shortest where that is longer.
pub(super) fn longest(limits: Limits, max_us: f64) -> Limits {
    let step = f64::from(limits.step.max(1));
    let steps = ((max_us / EXPOSURE_UNIT_US - f64::from(limits.least)) / step).floor().max(0.0);
    let most = (f64::from(limits.least) + steps * step).min(f64::from(limits.most));
    Limits { most: most as i32, ..limits }
}

impl Plan {
    /// The plan for a camera with the controls that `has` knows.
    pub(super) fn new(wanted: &ExposureSettings, has: &impl Has) -> Self {
        let mut plan = Self::default();
        if let Some(us) = wanted.exposure_us.or(wanted.auto_max_us) {
            plan.exposure(us, wanted.auto_max_us.is_some(), has);
        }
        plan.gain(wanted, has);
        plan
    }

    fn exposure(&mut self, us: f64, is_limit: bool, has: &impl Has) {
        let key = if is_limit { "auto_max_us" } else { "exposure_us" };
        let Some(limits) = has(Control::Exposure) else {
            self.lacks.push(format!(
                "{key}: the camera has no control {} (100 µs); its exposure stays as it is. Sensors of an SoC have \
                 their controls at /dev/v4l-subdev*",
                Control::Exposure.name()
            ));
            // What remains: the frame rate limits exposure.
            self.set_where_there(Control::DynamicRate, 0, has);
            return;
        };
        self.set_where_there(Control::AutoExposure, MANUAL[0], has);
        self.set_where_there(Control::DynamicRate, 0, has);
        let value = if is_limit { longest(limits, us).most } else { limits.nearest(us / EXPOSURE_UNIT_US) };
        let set_us = f64::from(value) * EXPOSURE_UNIT_US;
        let half_step_us = f64::from(limits.step.max(1)) * EXPOSURE_UNIT_US / 2.0;
        if (set_us - us).abs() > half_step_us && (set_us > us || !is_limit) {
            self.lacks.push(format!("{key} = {us}: the nearest exposure of this camera is {set_us:.0} µs"));
        }
        self.sets.push((Control::Exposure, value));
    }

    fn gain(&mut self, wanted: &ExposureSettings, has: &impl Has) {
        let automatic = wanted.auto_max_us.is_some() && has(Control::Exposure).is_some();
        match (wanted.gain, gain_of(has)) {
            (None, Some(_)) if automatic => self.set_where_there(Control::AutoGain, 0, has),
            (None, _) => {}
            (Some(_), None) => {
                self.lacks.push(format!("gain: the camera has no control {}", Control::Gain.name()));
            }
            (Some(gain), Some((control, limits))) => {
                self.set_where_there(Control::AutoGain, 0, has);
                let value = limits.nearest(f64::from(gain));
                if value != gain {
                    self.lacks.push(format!("gain = {gain}: the nearest gain of this camera is {value}"));
                }
                self.sets.push((control, value));
            }
        }
    }

    fn set_where_there(&mut self, control: Control, value: i32, has: &impl Has) {
        if has(control).is_some() {
            self.sets.push((control, value));
        }
    }

    /// Sets all of it; returns what the camera refuses, in words for the operator.
    pub(super) fn apply(&self, node: &Node) -> Vec<String> {
        self.sets.iter().filter_map(|&(control, value)| set(node, control, value).err()).collect()
    }
}

/// Sets one control.
pub(super) fn set(node: &Node, control: Control, value: i32) -> Result<(), String> {
    let values = if control == Control::AutoExposure { &MANUAL[..] } else { &[value] };
    let mut result = Ok(());
    for &value in values {
        result = node.set_control(control.id(), value);
        if result.is_ok() {
            break;
        }
    }
    result.map_err(|error| format!("the camera refuses {} = {value}: {error}", control.name()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXPOSURE: Limits = Limits { least: 3, most: 2047, step: 1 };
    const GAIN: Limits = Limits { least: 0, most: 255, step: 1 };
    const SWITCH: Limits = Limits { least: 0, most: 1, step: 1 };

    /// A USB camera.
    fn usb(control: Control) -> Option<Limits> {
        match control {
            Control::AutoExposure => Some(Limits { least: 0, most: 3, step: 1 }),
            Control::DynamicRate => Some(SWITCH),
            Control::Gain => Some(GAIN),
            Control::Exposure => Some(EXPOSURE),
            Control::AutoGain | Control::AnalogueGain => None,
        }
    }

    fn settings(exposure_us: Option<f64>, auto_max_us: Option<f64>, gain: Option<i32>) -> ExposureSettings {
        ExposureSettings { exposure_us, auto_max_us, gain }
    }

    #[test]
    fn nothing_requested_sets_nothing() {
        assert_eq!(Plan::new(&settings(None, None, None), &usb), Plan::default());
    }

    #[test]
    fn a_fixed_exposure_is_manual_first() {
        let plan = Plan::new(&settings(Some(2_000.0), None, Some(16)), &usb);
        let sets = [
            (Control::AutoExposure, 1),
            (Control::DynamicRate, 0),
            (Control::Exposure, 20),
            (Control::Gain, 16),
        ];
        assert_eq!((plan.sets.as_slice(), plan.lacks.as_slice()), (&sets[..], &[][..]));
    }

    #[test]
    fn a_limit_is_never_exceeded_where_the_camera_can_do_less() {
        let exposure = |us| {
            let plan = Plan::new(&settings(None, Some(us), None), &usb);
            let value = plan.sets.iter().find(|(control, _)| *control == Control::Exposure).map(|set| set.1);
            (value, plan.lacks.len())
        };
        assert_eq!(exposure(2_000.0), (Some(20), 0));
        assert_eq!(exposure(2_099.0), (Some(20), 0));
        assert_eq!(exposure(1e6), (Some(2047), 0));
        // The camera's shortest exposure is longer: set, and reported.
        assert_eq!(exposure(100.0), (Some(3), 1));
        let coarse = Limits { least: 10, most: 1000, step: 16 };
        assert_eq!(longest(coarse, 5_000.0), Limits { most: 42, ..coarse });
    }

    #[test]
    fn what_a_camera_lacks_is_reported_and_the_rest_is_set() {
        let plan = Plan::new(&settings(Some(50.0), None, Some(999)), &usb);
        assert_eq!(plan.sets.last(), Some(&(Control::Gain, 255)));
        assert!(plan.lacks[0].contains("300 µs") && plan.lacks[1].contains("255"), "{:?}", plan.lacks);

        let bare = |control| (control == Control::DynamicRate).then_some(SWITCH);
        let plan = Plan::new(&settings(None, Some(2_000.0), Some(1)), &bare);
        assert_eq!(plan.sets, [(Control::DynamicRate, 0)]);
        assert!(plan.lacks[0].contains("exposure_time_absolute") && plan.lacks[1].contains("gain"));

        let sensor = |control| match control {
            Control::AnalogueGain | Control::Exposure => Some(EXPOSURE),
            Control::AutoGain => Some(SWITCH),
            _ => None,
        };
        let plan = Plan::new(&settings(Some(1_000.0), None, Some(64)), &sensor);
        let sets = [(Control::Exposure, 10), (Control::AutoGain, 0), (Control::AnalogueGain, 64)];
        assert_eq!((plan.sets.as_slice(), plan.lacks.len()), (&sets[..], 0));
    }
}
