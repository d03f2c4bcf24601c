//! An epoch, combined from sentences of one time.

use super::calendar::Calendar;
use super::lines::LineSpan;
use super::report::{Date, Kind, Report, Solution};
use nalgebra::Vector3;
use windhover_base::msg::{FixKind, GnssEpoch};

/// Most sentences of one epoch; the order of further ones is not kept.
const KINDS_MAX: usize = 24;

/// An epoch in progress.
#[derive(Clone, Debug)]
pub(super) struct Draft {
    pub time_of_day_ns: Option<i64>,
    pub date: Option<Date>,
    /// Its sentences in order of arrival.
    pub kinds: Vec<Kind>,
    /// Where its burst began.
    pub begin: LineSpan,
    /// The place of its last sentence.
    pub end: LineSpan,
    /// Whether it was opened by the first sentence of a burst, so that its arrival determines the time.
    pub opens_burst: bool,
    void: bool,
    confirmed: bool,
    epoch: GnssEpoch,
    fix_reported: Option<FixKind>,
    solution: Option<Solution>,
    sats_listed: Option<u32>,
    ranks: Ranks,
}

/// The sentence from which a value was taken: a smaller rank is better.
#[derive(Clone, Copy, Debug)]
struct Ranks {
    position: u8,
    solution: u8,
    motion: u8,
    accuracy: u8,
    hdop: u8,
}

impl Draft {
    pub(super) fn new(begin: LineSpan, opens_burst: bool) -> Self {
        Self {
            time_of_day_ns: None,
            date: None,
            kinds: Vec::new(),
            begin,
            end: begin,
            opens_burst,
            void: false,
            confirmed: false,
            epoch: GnssEpoch::default(),
            fix_reported: None,
            solution: None,
            sats_listed: None,
            ranks: Ranks {
                position: u8::MAX,
                solution: u8::MAX,
                motion: u8::MAX,
                accuracy: u8::MAX,
                hdop: u8::MAX,
            },
        }
    }

    /// Whether it has a sentence of the receiver's main solution.
    pub(super) fn has_main(&self) -> bool {
        self.kinds.iter().any(|kind| matches!(kind, Kind::Rmc | Kind::Gga | Kind::Gns | Kind::Pvt))
    }

    /// Adds the values of a sentence of the same time.
    pub(super) fn merge(&mut self, report: &Report, span: LineSpan) {
        if self.kinds.len() < KINDS_MAX {
            self.kinds.push(report.kind);
        }
        self.end = span;
        self.time_of_day_ns = self.time_of_day_ns.or(report.time_of_day_ns);
        self.date = self.date.or(report.date);
        self.void |= report.valid == Some(false);
        self.confirmed |= report.valid == Some(true) || report.fix > Some(FixKind::None);
        self.fix_reported = self.fix_reported.max(report.fix);
        if let Some(listed) = report.sats_listed {
            self.sats_listed = Some(self.sats_listed.unwrap_or(0) + listed);
        }
        self.merge_position(report);
        self.merge_motion(report);
        self.merge_accuracy(report);
        let rank = hdop_rank(report.kind);
        if report.hdop.is_some() && rank < self.ranks.hdop {
            self.ranks.hdop = rank;
            self.epoch.hdop = report.hdop;
        }
        let epoch = &mut self.epoch;
        epoch.hpe_m = epoch.hpe_m.or(report.hpe_m);
        epoch.vpe_m = epoch.vpe_m.or(report.vpe_m);
        epoch.sats = epoch.sats.or(report.sats);
    }

    fn merge_position(&mut self, report: &Report) {
        let rank = position_rank(report.kind);
        if let Some((lat, lon)) = report.position_deg
            && rank < self.ranks.position
        {
            self.ranks.position = rank;
            self.epoch.lat_deg = Some(lat);
            self.epoch.lon_deg = Some(lon);
        }
        if report.solution.is_some() && rank < self.ranks.solution {
            self.ranks.solution = rank;
            self.solution = report.solution;
        }
        self.epoch.alt_msl_m = self.epoch.alt_msl_m.or(report.alt_msl_m);
        self.epoch.geoid_m = self.epoch.geoid_m.or(report.geoid_m);
    }

    fn merge_motion(&mut self, report: &Report) {
        let rank = motion_rank(report.kind);
        if report.speed_mps.is_some() && rank < self.ranks.motion {
            self.ranks.motion = rank;
            self.epoch.speed_mps = report.speed_mps;
            self.epoch.course_deg = report.course_deg;
        }
        if let Some(velocity) = report.vel_ned_mps {
            self.epoch.vel_ned_mps = Some(velocity);
            self.epoch.vel_has_down = true;
        }
    }

    /// A covariance takes precedence over the accuracies in the solution, and these over GST.
    fn merge_accuracy(&mut self, report: &Report) {
        let rank = accuracy_rank(report.kind);
        let says = report.position_sigma_m.is_some() || report.velocity_sigma_mps.is_some();
        if says && rank <= self.ranks.accuracy {
            self.ranks.accuracy = rank;
            let epoch = &mut self.epoch;
            epoch.position_sigma_m = report.position_sigma_m.or(epoch.position_sigma_m);
            epoch.velocity_sigma_mps = report.velocity_sigma_mps.or(epoch.velocity_sigma_mps);
        }
    }

    /// The finished epoch.
    pub(super) fn finish(&self, calendar: &mut Calendar) -> GnssEpoch {
        let mut epoch = self.epoch;
        epoch.time_of_day_ns = self.time_of_day_ns;
        epoch.fix = self.fix_kind();
        epoch.utc = calendar.utc_of(self.time_of_day_ns, self.date, self.has_fix(), self.begin.t_first);
        epoch.sats = epoch.sats.or(self.sats_listed);
        if epoch.fix == FixKind::None {
            return GnssEpoch {
                lat_deg: None,
                lon_deg: None,
                alt_msl_m: None,
                geoid_m: None,
                speed_mps: None,
                course_deg: None,
                vel_ned_mps: None,
                vel_has_down: false,
                position_sigma_m: None,
                velocity_sigma_mps: None,
                ..epoch
            };
        }
        if epoch.vel_ned_mps.is_none() {
            epoch.vel_ned_mps = velocity_of(epoch.speed_mps, epoch.course_deg);
        }
        epoch
    }

    /// Whether its values so far are a fix.
    pub(super) fn has_fix(&self) -> bool {
        self.fix_kind() != FixKind::None
    }

    /// The fix kind on which all sentences agree: a sentence that marks the fix as void decides.
    fn fix_kind(&self) -> FixKind {
        if self.void || !self.confirmed || self.epoch.lat_deg.is_none() {
            return FixKind::None;
        }
        let reported = self.fix_reported;
        let flat_or_not = reported.unwrap_or(match self.epoch.alt_msl_m {
            Some(_) => FixKind::ThreeD,
            None => FixKind::TwoD,
        });
        match (flat_or_not, self.solution) {
            (FixKind::ThreeD, Some(Solution::RtkFixed)) => FixKind::RtkFixed,
            (FixKind::ThreeD, Some(Solution::RtkFloat)) => FixKind::RtkFloat,
            _ => flat_or_not,
        }
    }
}

/// Horizontal velocity from speed and course. Without a course (receivers omit it at low speed) it is known only when
/// the speed is zero.
fn velocity_of(speed_mps: Option<f64>, course_deg: Option<f64>) -> Option<Vector3<f64>> {
    let speed = speed_mps?;
    match course_deg {
        Some(course) => {
            let (sin, cos) = course.to_radians().sin_cos();
            // Adding zero removes the sign of −0.
            Some(Vector3::new(speed * cos + 0.0, speed * sin + 0.0, 0.0))
        }
        None => (speed == 0.0).then(Vector3::zeros),
    }
}

const fn position_rank(kind: Kind) -> u8 {
    match kind {
        Kind::Pvt => 0,
        Kind::Gga => 1,
        Kind::Gns => 2,
        Kind::Rmc => 3,
        Kind::Gll => 4,
        _ => 5,
    }
}

const fn motion_rank(kind: Kind) -> u8 {
    match kind {
        Kind::Pvt => 0,
        Kind::Rmc => 1,
        Kind::Vtg => 2,
        _ => 3,
    }
}

const fn hdop_rank(kind: Kind) -> u8 {
    match kind {
        Kind::Gga => 0,
        Kind::Gns => 1,
        _ => 2,
    }
}

const fn accuracy_rank(kind: Kind) -> u8 {
    match kind {
        Kind::Cov => 0,
        Kind::Pvt => 1,
        _ => 2,
    }
}
