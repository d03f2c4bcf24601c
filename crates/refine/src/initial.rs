//! Initial values: the filter's estimates of the flight.

use nalgebra::{UnitQuaternion, Vector3};

use windhover_base::msg::{EstimatorOutput, FeltTilt, MisfitCause, Ownship, TargetEstimate, TrackStatus};
use windhover_base::settings::{EstimatorConfig, Rig};
use windhover_base::time::{MonoTime, Span};
use windhover_estimate::{Estimator, Site};

use crate::recording::{Measured, Recording};
use crate::unknowns::knot;
use crate::values::Knot;

/// Period of the filter's own states, s.
const STEP_S: f64 = 0.1;
/// How far behind the last event they are requested: by then late measurements are included.
const BEHIND: Span = Span::from_ns(300_000_000);

/// The filter's result for one flight.
#[derive(Clone, Debug, Default)]
pub(crate) struct InitialValues {
    /// In order of time, each instant once.
    pub(crate) own: Vec<Ownship>,
    /// Of each target, where it was tracked, in order of time.
    pub(crate) targets: Vec<Vec<TargetEstimate>>,
    pub(crate) felt: Option<FeltTilt>,
    /// Targets that the filter found to sway on their springs.
    pub(crate) sways: Vec<bool>,
    /// What the filter found to be configured wrongly.
    pub(crate) wrong: Vec<MisfitCause>,
    /// Of a camera that the filter found to shake: displacement of rows and roll, rad, and the time from the first row to the last, s.
    pub(crate) shake: Option<([f64; 2], f64)>,
    /// How many times as far as configured the receiver's slow error wanders.
    pub(crate) wanders: f64,
    /// Why and when the filter was reset.
    pub(crate) resets: Vec<(MonoTime, String)>,
}

/// Runs the filter over a recording.
pub(crate) fn filtered(
    rig: &Rig,
    estimator: &EstimatorConfig,
    site: &Site,
    recording: &Recording,
) -> InitialValues {
    let mut filter = Estimator::new(rig, estimator, site);
    let mut first = InitialValues {
        targets: vec![Vec::new(); rig.target.len()],
        sways: vec![false; rig.target.len()],
        wanders: 1.0,
        ..InitialValues::default()
    };
    let (mut out, mut asked) = (Vec::new(), None);
    for arrival in recording.in_order() {
        match arrival {
            Measured::Epoch(epoch) => filter.gnss(epoch, &mut out),
            Measured::Reading(sample) => filter.attitude(sample, &mut out),
            Measured::Frame(frame) => filter.frame(frame, &mut out),
        }
        let t = arrival.t_recv();
        filter.tick(t, &mut out);
        if asked.is_none_or(|asked| t - asked >= Span::from_s(STEP_S)) {
            asked = Some(t);
            first.own.extend(filter.ownship(t - BEHIND));
        }
        first.take(&mut out, t);
    }
    filter.finish(&mut out);
    first.shake = filter.camera_shake();
    first.take(&mut out, MonoTime::default());
    first.own.sort_by_key(|own| own.t_valid);
    first.own.dedup_by_key(|own| own.t_valid);
    first.targets.iter_mut().for_each(|track| track.sort_by_key(|e| e.t_valid));
    first
}

impl InitialValues {
    fn take(&mut self, out: &mut Vec<EstimatorOutput>, t: MonoTime) {
        for said in out.drain(..) {
            match said {
                EstimatorOutput::Ownship(own) => self.own.push(own),
                EstimatorOutput::Smoothed(e)
                    if e.state.is_some()
                        && matches!(e.status, TrackStatus::Tracking | TrackStatus::Acquiring) =>
                {
                    self.targets[e.target].push(e);
                }
                EstimatorOutput::TiltFelt { felt, .. } => self.felt = Some(felt),
                EstimatorOutput::Misfit(misfit) => match misfit.cause {
                    MisfitCause::TargetSways { target } => self.sways[target] = true,
                    MisfitCause::AntennaPlace
                    | MisfitCause::Lens
                    | MisfitCause::Readout
                    | MisfitCause::Late
                    | MisfitCause::MarkerSize(_)
                    | MisfitCause::MarkerPlace(_)
                    | MisfitCause::MarkerTurn(_)
                        if !self.wrong.contains(&misfit.cause) =>
                    {
                        self.wrong.push(misfit.cause);
                    }
                    MisfitCause::Wanders => self.wanders = self.wanders.max(misfit.figure),
                    _ => {}
                },
                EstimatorOutput::Reset { reason } => self.resets.push((t, reason.to_owned())),
                _ => {}
            }
        }
    }

    /// The time span in which the helicopter's state is known.
    pub(crate) fn span(&self) -> Option<(MonoTime, MonoTime)> {
        Some((self.own.first()?.t_valid, self.own.last()?.t_valid))
    }

    /// The helicopter at a time between two of its states; targets are left at zero.
    pub(crate) fn knot_at(&self, t: MonoTime, targets: usize) -> Knot {
        let after = self.own.partition_point(|own| own.t_valid < t).min(self.own.len() - 1);
        let (a, b) = (&self.own[after.saturating_sub(1)], &self.own[after]);
        let whole = (b.t_valid - a.t_valid).s();
        let share = if whole > 0.0 { ((t - a.t_valid).s() / whole).clamp(0.0, 1.0) } else { 1.0 };
        let mix = |a: &Vector3<f64>, b: &Vector3<f64>| a + (b - a) * share;
        let attitude: UnitQuaternion<f64> = a.ned_from_body.nlerp(&b.ned_from_body, share);
        let mut x = vec![0.0; knot::target(targets)];
        x[knot::POSITION..][..3].copy_from_slice(mix(&a.position_ned_m, &b.position_ned_m).as_slice());
        x[knot::VELOCITY..][..3].copy_from_slice(mix(&a.velocity_ned_mps, &b.velocity_ned_mps).as_slice());
        if whole > 0.0 {
            let turn = (a.ned_from_body.inverse() * b.ned_from_body).scaled_axis() / whole;
            x[knot::RATE..][..3].copy_from_slice(turn.as_slice());
        }
        Knot { attitude: attitude.to_rotation_matrix(), x }
    }
}
