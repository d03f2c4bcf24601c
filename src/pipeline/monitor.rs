//! Health once a second, and notices of changes.

use std::collections::BTreeMap;

use windhover_base::msg::{
    Disposition, FixKind, GnssEpoch, Health, Misfit, Notice, NoticeKind, Output, PerSource, Source,
    SourceHealth, Stamped, TargetEstimate, TargetHealth, TrackStatus,
};
use windhover_base::settings::Rig;
use windhover_base::time::{MonoTime, PulseTrouble, Span};

use super::misfits::Misfits;

/// Period of the health message.
const HEALTH_PERIOD: Span = Span::from_ns(1_000_000_000);

/// Counts of one source.
#[derive(Clone, Copy, Default)]
struct SourceCount {
    total: u64,
    at_last_health: u64,
    last: Option<MonoTime>,
    refused: u64,
    refused_reported: u64,
    dropped: u64,
    silent: bool,
}

/// Watches the flow of data and reports what an operator should know.
pub(super) struct Monitor {
    names: Vec<String>,
    misfits: Misfits,
    watched: Vec<Source>,
    sources: PerSource<SourceCount>,
    fix: FixKind,
    sats: Option<u32>,
    hdop: Option<f64>,
    geoid_m: Option<f64>,
    clock_sigma: Option<Span>,
    utc_minus_host: Option<Span>,
    targets: Vec<TargetHealth>,
    dispositions: BTreeMap<Disposition, u64>,
    began: Option<MonoTime>,
    next_health: Option<MonoTime>,
    tracked: bool,
    pulses_unused: Option<PulseTrouble>,
}

impl Monitor {
    /// Watches these sources, and the targets of the rig.
    pub(super) fn new(watched: Vec<Source>, rig: &Rig) -> Self {
        let names: Vec<String> = rig.target.iter().map(|target| target.name.clone()).collect();
        let lost = |target| TargetEstimate {
            t_valid: MonoTime::default(),
            frame: 0,
            target,
            status: TrackStatus::Lost,
            state: None,
        };
        Self {
            watched,
            sources: PerSource::default(),
            fix: FixKind::None,
            sats: None,
            hdop: None,
            geoid_m: None,
            clock_sigma: None,
            utc_minus_host: None,
            targets: (0..names.len()).map(|i| TargetHealth { frames_seen: 0, last: lost(i) }).collect(),
            names,
            misfits: Misfits::new(rig),
            dispositions: BTreeMap::new(),
            began: None,
            next_health: None,
            tracked: false,
            pulses_unused: None,
        }
    }

    /// Whether any target has been tracked so far.
    pub(super) fn has_tracked(&self) -> bool {
        self.tracked
    }

    /// Time has advanced to `t`: reports health that is due and silences that have lasted long enough. Both follow the
    /// recording's own clock, so that a replay reports the same.
    pub(super) fn advance(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        let began = *self.began.get_or_insert(t);
        let mut due = *self.next_health.get_or_insert(began + HEALTH_PERIOD);
        if t - due > Span::from_s(60.0) {
            out.push(notice(t, NoticeKind::ClockJump, None, format!("time leapt by {:.0} s", (t - due).s())));
            due = t;
        }
        while t >= due {
            self.silences(due, out);
            out.push(Output::Health(Box::new(self.health(due))));
            let next = due + HEALTH_PERIOD;
            if next <= due {
                // The end of representable time, which a wrong stamp can give: nothing follows it.
                break;
            }
            due = next;
        }
        self.next_health = Some(due);
    }

    fn silences(&mut self, t: MonoTime, out: &mut Vec<Output>) {
        let began = self.began.unwrap_or(t);
        for &source in &self.watched {
            let count = &mut self.sources[source];
            let quiet = t - count.last.unwrap_or(began);
            if !count.silent && quiet >= source.silent_after() {
                count.silent = true;
                if source == Source::Gps {
                    // The fix that a receiver gave before it fell silent is not a current fix.
                    (self.fix, self.sats, self.hdop) = (FixKind::None, None, None);
                }
                let detail = format!("nothing to use from the {} for {:.1} s", source.name(), quiet.s());
                out.push(notice(t, NoticeKind::SourceSilent, Some(source), detail));
            }
        }
    }

    fn health(&mut self, t: MonoTime) -> Health {
        let mut figures = |&source: &Source| {
            let count = &mut self.sources[source];
            let rate_hz = (count.total - count.at_last_health) as f64 / HEALTH_PERIOD.s();
            count.at_last_health = count.total;
            SourceHealth {
                source,
                rate_hz,
                age: count.last.map(|last| t - last),
                total: count.total,
                refused: count.refused,
                dropped: count.dropped,
            }
        };
        let health = Health {
            t,
            sources: self.watched.iter().map(&mut figures).collect(),
            fix: self.fix,
            sats: self.sats,
            hdop: self.hdop,
            geoid_m: self.geoid_m,
            clock_sigma: self.clock_sigma,
            utc_minus_host: self.utc_minus_host,
            targets: self.targets.clone(),
            dispositions: self.dispositions.clone(),
            misfits: self.misfits.now(t),
        };
        self.targets.iter_mut().for_each(|target| target.frames_seen = 0);
        health
    }

    /// A source delivered data that can be used.
    pub(super) fn delivered(&mut self, source: Source, t: MonoTime, out: &mut Vec<Output>) {
        let count = &mut self.sources[source];
        count.total += 1;
        if count.silent {
            count.silent = false;
            let quiet = count.last.map_or(String::new(), |last| format!(" after {:.1} s", (t - last).s()));
            let detail = format!("the {} is back{quiet}", source.name());
            out.push(notice(t, NoticeKind::SourceBack, Some(source), detail));
        }
        count.last = Some(t);
    }

    /// The number of refused pieces of a source's bytes so far, and the last reason.
    pub(super) fn refused(
        &mut self,
        source: Source,
        t: MonoTime,
        total: u64,
        why: &str,
        out: &mut Vec<Output>,
    ) {
        let count = &mut self.sources[source];
        count.refused = total;
        if total > count.refused_reported {
            let detail =
                format!("{} refused from the {}: {why}", total - count.refused_reported, source.name());
            count.refused_reported = total;
            out.push(notice(t, NoticeKind::BytesRefused, Some(source), detail));
        }
    }

    /// A frame could not be used.
    pub(super) fn frame_unusable(&mut self, t: MonoTime, why: String, out: &mut Vec<Output>) {
        self.sources[Source::Camera].refused += 1;
        out.push(notice(t, NoticeKind::FrameUnusable, Some(Source::Camera), why));
    }

    /// Something was lost before it could be recorded.
    pub(super) fn dropped(&mut self, source: Source, t: MonoTime, lost: u32, out: &mut Vec<Output>) {
        self.sources[source].dropped += u64::from(lost);
        let detail = format!("{lost} lost from the {} before they could be recorded", source.name());
        out.push(notice(t, NoticeKind::Dropped, Some(source), detail));
    }

    /// The receiver's fix and the state of the time fit, with its one-sigma where the fit gave the epoch its time.
    pub(super) fn fix(
        &mut self,
        t: MonoTime,
        epoch: &Stamped<GnssEpoch>,
        clock_sigma: Option<Span>,
        out: &mut Vec<Output>,
    ) {
        let GnssEpoch { fix, sats, utc, .. } = epoch.value;
        if let (true, Some(utc), Some(_)) = (fix.has_position(), utc, clock_sigma) {
            self.utc_minus_host = Some(Span::from_ns(utc.unix_ns() - epoch.t_valid.ns()));
        }
        let had = self.fix.has_position();
        let has = fix.has_position();
        if has && !had {
            let satellites = sats.map_or(String::new(), |n| format!(", {n} satellites"));
            let detail = format!("the receiver has a {} fix{satellites}", fix.name());
            out.push(notice(t, NoticeKind::FixAcquired, Some(Source::Gps), detail));
        } else if had && !has {
            let detail = "the receiver has no fix".to_owned();
            out.push(notice(t, NoticeKind::FixLost, Some(Source::Gps), detail));
        }
        (self.fix, self.sats, self.clock_sigma) = (fix, sats, clock_sigma);
        self.hdop = epoch.value.hdop;
        self.geoid_m = epoch.value.geoid_m.or(self.geoid_m);
    }

    /// The reason why the receiver's pulses are not used, if they are not.
    pub(super) fn pulses(&mut self, t: MonoTime, trouble: Option<PulseTrouble>, out: &mut Vec<Output>) {
        if let Some(trouble) = trouble.filter(|trouble| self.pulses_unused != Some(*trouble)) {
            out.push(notice(t, NoticeKind::PulseUnused, Some(Source::Gps), trouble.words().to_owned()));
        }
        self.pulses_unused = trouble;
    }

    /// A frame in which a marker of the target was seen.
    pub(super) fn seen(&mut self, target: usize) {
        if let Some(target) = self.targets.get_mut(target) {
            target.frames_seen += 1;
        }
    }

    /// Whether a target is lost, or was never found.
    pub(super) fn is_lost(&self, target: usize) -> bool {
        self.targets.get(target).is_none_or(|target| target.last.status == TrackStatus::Lost)
    }

    /// Whether there is an estimate of any target.
    pub(super) fn is_any_known(&self) -> bool {
        (0..self.targets.len()).any(|target| !self.is_lost(target))
    }

    /// A target's estimate.
    pub(super) fn estimate(&mut self, estimate: &TargetEstimate, t: MonoTime, out: &mut Vec<Output>) {
        let Some(target) = self.targets.get_mut(estimate.target) else { return };
        let before = target.last.status;
        target.last = *estimate;
        self.tracked |= estimate.status == TrackStatus::Tracking;
        let name = &self.names[estimate.target];
        let (kind, detail) = match (before, estimate.status) {
            (TrackStatus::Lost | TrackStatus::Acquiring, TrackStatus::Tracking) => {
                (NoticeKind::TargetTracking, format!("tracking {name}"))
            }
            (TrackStatus::Coasting, TrackStatus::Tracking) => {
                (NoticeKind::TargetTracking, format!("tracking {name} again"))
            }
            (TrackStatus::Tracking, TrackStatus::Coasting) => {
                (NoticeKind::TargetCoasting, format!("no marker of {name} in view, predicting"))
            }
            (TrackStatus::Tracking | TrackStatus::Coasting, TrackStatus::Lost) => {
                (NoticeKind::TargetLost, format!("lost {name}"))
            }
            _ => return,
        };
        let target = Some(name.clone());
        out.push(Output::Notice(Notice { t, kind, source: None, target, detail, misfit: None }));
    }

    /// The configuration does not fit the measurements.
    pub(super) fn misfit(&mut self, misfit: &Misfit, t: MonoTime, out: &mut Vec<Output>) {
        let Some(words) = self.misfits.take(misfit, t) else { return };
        let (kind, detail) = (NoticeKind::ModelMisfit, words.to_string());
        let misfit = Some(words);
        out.push(Output::Notice(Notice { t, kind, source: None, target: None, detail, misfit }));
    }

    /// The result of a measurement in the filter.
    pub(super) fn disposition(&mut self, disposition: Disposition) {
        *self.dispositions.entry(disposition).or_default() += 1;
    }
}

/// A notice as an output.
pub(super) fn notice(t: MonoTime, kind: NoticeKind, source: Option<Source>, detail: String) -> Output {
    Output::Notice(Notice { t, kind, source, target: None, detail, misfit: None })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn the_end_of_time_is_one_moment() {
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let mut monitor = Monitor::new(vec![Source::Gps], &config.rig());
        let mut out = Vec::new();
        for t in [0, i64::MAX - 1, i64::MAX, i64::MAX] {
            monitor.advance(MonoTime::from_ns(t), &mut out);
        }
        assert!(out.len() < 10, "{} outputs", out.len());
    }

    #[test]
    fn a_fix_goes_with_the_receiver_that_reported_it() {
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let mut monitor = Monitor::new(vec![Source::Gps], &config.rig());
        let at = |s: f64| MonoTime::from_ns(0) + Span::from_s(s);
        let mut out = Vec::new();
        monitor.advance(at(0.0), &mut out);
        let value =
            GnssEpoch { fix: FixKind::ThreeD, sats: Some(9), hdop: Some(0.9), ..GnssEpoch::default() };
        let epoch = Stamped { t_valid: at(1.0), t_recv: at(1.0), seq: 0, value };
        monitor.delivered(Source::Gps, at(1.0), &mut out);
        monitor.fix(at(1.0), &epoch, None, &mut out);
        for s in 1..30 {
            monitor.advance(at(f64::from(s) + 0.5), &mut out);
        }
        let healths = out.iter().filter_map(|o| match o {
            Output::Health(health) => Some((health.t, health.fix, health.sats)),
            _ => None,
        });
        for (t, fix, sats) in healths.filter(|(t, ..)| *t > at(1.0)) {
            let is_there = t - at(1.0) < Source::Gps.silent_after();
            let expected = if is_there { (FixKind::ThreeD, Some(9)) } else { (FixKind::None, None) };
            assert_eq!((fix, sats), expected, "at {:.1} s", (t - at(0.0)).s());
        }
    }

    #[test]
    fn only_the_sources_there_are_can_be_silent() {
        // Given a pipeline that has a receiver and a camera.
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let mut monitor = Monitor::new(vec![Source::Gps, Source::Camera], &config.rig());
        let mut out = Vec::new();
        let at = |s: f64| MonoTime::from_ns(0) + Span::from_s(s);
        monitor.advance(at(0.0), &mut out);
        // When only frames arrive.
        for n in 1..=40 {
            monitor.delivered(Source::Camera, at(0.1 * f64::from(n)), &mut out);
            monitor.advance(at(0.1 * f64::from(n)), &mut out);
        }
        // Then the receiver's silence is reported once, and health names both sources.
        let silent = out.iter().filter_map(|o| match o {
            Output::Notice(notice) if notice.kind == NoticeKind::SourceSilent => notice.source,
            _ => None,
        });
        assert_eq!(silent.collect::<Vec<_>>(), [Source::Gps]);
        let healths = out.iter().filter_map(|o| match o {
            Output::Health(health) => Some(health.sources.iter().map(|s| s.source).collect::<Vec<_>>()),
            _ => None,
        });
        assert!(healths.clone().count() >= 3);
        healths.for_each(|sources| assert_eq!(sources, [Source::Gps, Source::Camera]));
    }
}
