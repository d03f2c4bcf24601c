//! Readings of the lines through the pipeline: the datum, and the estimators.

use windhover_base::geo::Geodetic;
use windhover_base::msg::{
    AttitudeSample, EstimatorOutput, GnssEpoch, NoticeKind, Output, SensorReading, Source, Stamped,
};
use windhover_base::time::MonoTime;
use windhover_estimate::{Estimator, PaperEstimator};

use super::monitor::notice;
use super::{Estimators, Pipeline};

/// Most readings held until the datum is settled: some seconds of both lines.
const HELD_MAX: usize = 512;

impl Pipeline {
    pub(super) fn delivered_or_refused(
        &mut self,
        source: Source,
        t: MonoTime,
        usable: bool,
        refused: u64,
        out: &mut Vec<Output>,
    ) {
        match usable {
            true => self.monitor.delivered(source, t, out),
            false => self.monitor.refused(source, t, refused, "values that cannot be", out),
        }
    }

    pub(super) fn take_readings(&mut self, source: Source, t: MonoTime, out: &mut Vec<Output>) {
        for reading in std::mem::take(&mut self.readings) {
            self.monitor.delivered(source, t, out);
            match reading {
                SensorReading::Gnss(epoch) => self.gnss(&epoch, t, out),
                SensorReading::Attitude(sample) => self.attitude(&sample, out),
                SensorReading::SecondAttitude(sample) => {
                    self.tell_joint(|joint, out| joint.second_attitude(&sample, out));
                }
                SensorReading::Inertial(sample) => {
                    self.tell_joint(|joint, out| joint.inertial(&sample, out));
                }
                SensorReading::Autopilot(_) => out.push(Output::Reading(reading)),
            }
        }
        self.take_estimated(t, out);
    }

    pub(super) fn gnss(&mut self, epoch: &Stamped<GnssEpoch>, t: MonoTime, out: &mut Vec<Output>) {
        self.monitor.fix(t, epoch, self.lines.gps.clock_sigma(), out);
        self.monitor.pulses(t, self.lines.gps.pulse_trouble(), out);
        out.push(Output::Reading(SensorReading::Gnss(*epoch)));
        let agreed = self.finder.agreeing();
        self.settle(&epoch.value, t, out);
        if self.estimators.is_none() {
            self.hold_fix(epoch, agreed);
        }
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.gnss(epoch, &mut self.estimated);
            estimators.paper.gnss(epoch, &mut self.papered);
        }
    }

    pub(super) fn attitude(&mut self, sample: &Stamped<AttitudeSample>, out: &mut Vec<Output>) {
        out.push(Output::Reading(SensorReading::Attitude(*sample)));
        if let Some(estimators) = &mut self.estimators {
            estimators.joint.attitude(sample, &mut self.estimated);
            estimators.paper.attitude(sample, &mut self.papered);
        } else if !self.held.is_empty() && self.held.len() < HELD_MAX {
            self.held.push(SensorReading::Attitude(*sample));
        }
    }

    pub(super) fn tell_joint(&mut self, take: impl FnOnce(&mut Estimator, &mut Vec<EstimatorOutput>)) {
        if let Some(estimators) = &mut self.estimators {
            take(&mut estimators.joint, &mut self.estimated);
        }
    }

    /// Holds a fix that agrees with `agreed` fixes before it; a fix that does not agree starts the count again.
    pub(super) fn hold_fix(&mut self, epoch: &Stamped<GnssEpoch>, agreed: usize) {
        let agreeing = self.finder.agreeing();
        if agreeing == 1 {
            self.held.clear();
        }
        if (agreeing == 1 || agreeing > agreed) && self.held.len() < HELD_MAX {
            self.held.push(SensorReading::Gnss(*epoch));
        }
    }

    pub(super) fn settle(&mut self, epoch: &GnssEpoch, t: MonoTime, out: &mut Vec<Output>) {
        let settled = match &self.estimators {
            None => self.finder.offer(epoch),
            Some(estimators) => {
                let [lat_deg, lon_deg, height_m] = estimators.site.datum;
                let datum = Geodetic { lat_deg, lon_deg, height_m };
                self.finder.offer_again(epoch, datum, self.monitor.has_tracked())
            }
        };
        if let Some(why) = self.finder.unused_word() {
            let words = format!("the receiver's positions are not used: {why}");
            out.push(notice(t, NoticeKind::PositionsUnused, Some(Source::Gps), words));
        }
        let Some(settled) = settled else { return };
        if let Some(words) = settled.declination_notice {
            out.push(notice(t, NoticeKind::Declination, Some(Source::Compass), words));
        }
        if let Some(words) = settled.ground_notice {
            out.push(notice(t, NoticeKind::TerrainMissing, None, words));
        }
        let datum: Geodetic = settled.site.frame.datum();
        let words = format!(
            "datum {:.7} {:.7}, {:.1} m above the ellipsoid",
            datum.lat_deg, datum.lon_deg, datum.height_m
        );
        out.push(notice(t, NoticeKind::DatumSet, Some(Source::Gps), words));
        out.push(Output::Datum(t, datum));
        let (rig, filter) = (&self.settings.rig, &self.settings.filter);
        let mut joint = Estimator::new(rig, filter, &settled.site);
        if let Some(warm) = self.warm.take().filter(|_| settled.continued) {
            joint.resume(warm);
        }
        let mut paper = PaperEstimator::new(rig, filter, &settled.site);
        for reading in self.held.drain(..) {
            match reading {
                SensorReading::Gnss(epoch) => {
                    joint.gnss(&epoch, &mut self.estimated);
                    paper.gnss(&epoch, &mut self.papered);
                }
                SensorReading::Attitude(sample) => {
                    joint.attitude(&sample, &mut self.estimated);
                    paper.attitude(&sample, &mut self.papered);
                }
                _ => {}
            }
        }
        self.estimators = Some(Estimators { joint, paper, site: settled.warm });
    }
}
