//! Placement of knots in time, assignment of measurements to knots, and the lifetime of each ground feature.

use std::collections::BTreeMap;

use windhover_base::msg::MarkerId;
use windhover_base::time::{MonoTime, Span};

use crate::initial::InitialValues;
use crate::recording::Recording;

/// Largest distance of two knots, s.
const STEP_S: f64 = 0.1;
/// Frames nearer to each other than this do not share a knot unless they have the same time.
const NEAR: Span = Span::from_ns(1_000_000);
/// Without a fix and a compass reading for longer than this, a new trajectory begins, s.
const BREAK_S: f64 = 10.0;
/// Length of a window of time, s: a vehicle starts or turns within some of them.
const WINDOW_S: f64 = 1.0;
/// Most ground features that are open at once.
pub(crate) const LANDMARKS: usize = 12;
/// A feature detected in fewer frames is not used.
const FEWEST_SIGHTINGS: usize = 4;

/// A detection of a ground feature: its landmark, its place in the front, its index among the frame's features.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FeatureSeen {
    pub(crate) landmark: usize,
    pub(crate) place: usize,
    pub(crate) index: usize,
}

/// A knot's time, and the measurements nearest to it.
#[derive(Clone, Debug)]
pub(crate) struct Stop {
    pub(crate) t: MonoTime,
    /// Index of the recording.
    pub(crate) flight: usize,
    /// Number of its window of time: motion factors are constant in it.
    pub(crate) window: usize,
    /// Whether it is not connected to the previous knot.
    pub(crate) begins: bool,
    /// Index of the frame exposed at `t`.
    pub(crate) frame: Option<usize>,
    pub(crate) epochs: Vec<usize>,
    pub(crate) readings: Vec<usize>,
    pub(crate) positions: Vec<usize>,
    pub(crate) features: Vec<FeatureSeen>,
    /// Places of landmarks that are detected here for the last time, with the landmark.
    pub(crate) closes: Vec<(usize, usize)>,
    /// For each target: whether it is estimated here, and whether that begins here.
    pub(crate) held: Vec<bool>,
    pub(crate) taken_up: Vec<bool>,
}

/// All knots of all flights.
#[derive(Clone, Debug, Default)]
pub(crate) struct Plan {
    pub(crate) stops: Vec<Stop>,
    /// Number of landmarks.
    pub(crate) landmarks: usize,
    /// Places of the front that landmarks take.
    pub(crate) places: usize,
    /// Windows of time.
    pub(crate) windows: usize,
}

impl Plan {
    /// Adds a flight; `find` returns the target of a marker, `lost_after_s` is the longest gap over which a target is
    /// still estimated.
    pub(crate) fn add(
        &mut self,
        flight: usize,
        recording: &Recording,
        first: &InitialValues,
        find: &dyn Fn(MarkerId) -> Option<usize>,
        targets: usize,
        lost_after_s: f64,
    ) {
        let Some((from, to)) = first.span() else { return };
        let begin = self.stops.len();
        let inside = |t: MonoTime| from <= t && t <= to;
        let mut frames: Vec<(MonoTime, usize)> = recording
            .frames
            .iter()
            .enumerate()
            .map(|(i, f)| (f.t_valid, i))
            .filter(|(t, _)| inside(*t))
            .collect();
        frames.sort();
        frames.dedup_by(|b, a| b.0 - a.0 < NEAR);
        self.lay(flight, (from, to), &frames, targets);
        self.stops[begin].begins = true;
        let stops = &mut self.stops[begin..];
        for (i, epoch) in recording.epochs.iter().enumerate().filter(|(_, e)| inside(e.t_valid)) {
            stops[nearest(stops, epoch.t_valid)].epochs.push(i);
        }
        for (i, reading) in recording.readings.iter().enumerate().filter(|(_, r)| inside(r.t_valid)) {
            stops[nearest(stops, reading.t_valid)].readings.push(i);
        }
        for (i, position) in recording.positions.iter().enumerate().filter(|(_, p)| inside(p.t)) {
            stops[nearest(stops, position.t)].positions.push(i);
        }
        self.break_at_silences(begin);
        self.number_windows(begin);
        self.follow_targets(begin, recording, find, targets, lost_after_s);
        self.follow_features(begin, recording);
    }

    fn lay(
        &mut self,
        flight: usize,
        (from, to): (MonoTime, MonoTime),
        frames: &[(MonoTime, usize)],
        targets: usize,
    ) {
        let stop = |t: MonoTime, frame: Option<usize>| Stop {
            t,
            flight,
            window: 0,
            begins: false,
            frame,
            epochs: Vec::new(),
            readings: Vec::new(),
            positions: Vec::new(),
            features: Vec::new(),
            closes: Vec::new(),
            held: vec![false; targets],
            taken_up: vec![false; targets],
        };
        let mut last: Option<MonoTime> = None;
        let ends = [(from, None), (to, None)];
        let mut times: Vec<(MonoTime, Option<usize>)> =
            frames.iter().map(|(t, i)| (*t, Some(*i))).chain(ends).collect();
        times.sort_by_key(|(t, frame)| (*t, frame.is_none()));
        times.dedup_by(|b, a| b.0 - a.0 < NEAR && b.1.is_none());
        for (t, frame) in times {
            if let Some(last) = last {
                let gap_s = (t - last).s();
                let steps = (gap_s / STEP_S).ceil().max(1.0) as i64;
                let between = (1..steps).map(|k| last + Span::from_s(gap_s * k as f64 / steps as f64));
                self.stops.extend(between.map(|t| stop(t, None)));
            }
            self.stops.push(stop(t, frame));
            last = Some(t);
        }
    }

    fn number_windows(&mut self, begin: usize) {
        let mut window = self.windows;
        let mut since = self.stops[begin].t;
        for stop in &mut self.stops[begin..] {
            if (stop.t - since).s() >= WINDOW_S {
                (window, since) = (window + 1, stop.t);
            }
            stop.window = window;
        }
        self.windows = window + 1;
    }

    /// Removes knots of long silences, and begins a new trajectory after them.
    fn break_at_silences(&mut self, begin: usize) {
        let tail = self.stops.split_off(begin);
        let measured = |stop: &Stop| !(stop.epochs.is_empty() && stop.readings.is_empty());
        let known: Vec<MonoTime> = tail.iter().filter(|s| measured(s)).map(|s| s.t).collect();
        for mut stop in tail {
            let next = known.partition_point(|t| *t < stop.t);
            let (before, after) = (next.checked_sub(1).map(|i| known[i]), known.get(next));
            let silent = match (before, after) {
                (Some(before), Some(after)) => *after != stop.t && (*after - before).s() > BREAK_S,
                _ => false,
            };
            if silent {
                continue;
            }
            if let Some(last) = self.stops[begin..].last() {
                stop.begins = (stop.t - last.t).s() > BREAK_S;
            }
            self.stops.push(stop);
        }
        if let Some(first) = self.stops.get_mut(begin) {
            first.begins = true;
        }
    }

    /// Where each target is estimated: from one detection to the next one that comes soon enough.
    fn follow_targets(
        &mut self,
        begin: usize,
        recording: &Recording,
        find: &dyn Fn(MarkerId) -> Option<usize>,
        targets: usize,
        lost_after_s: f64,
    ) {
        let stops = &mut self.stops[begin..];
        for target in 0..targets {
            let shows = |stop: &Stop| {
                let frame = stop.frame.map(|i| &recording.frames[i].value);
                frame.is_some_and(|f| f.markers.iter().any(|m| find(m.marker) == Some(target)))
            };
            let mut last: Option<usize> = None;
            for k in 0..stops.len() {
                if stops[k].begins {
                    last = None;
                }
                if !shows(&stops[k]) {
                    continue;
                }
                let tied = last.filter(|last| (stops[k].t - stops[*last].t).s() <= lost_after_s);
                match tied {
                    Some(last) => stops[last + 1..=k].iter_mut().for_each(|stop| stop.held[target] = true),
                    None => (stops[k].held[target], stops[k].taken_up[target]) = (true, true),
                }
                last = Some(k);
            }
        }
    }

    /// Assigns a landmark to each feature that is detected often enough, and a place of the front while it is open.
    fn follow_features(&mut self, begin: usize, recording: &Recording) {
        let stops = &mut self.stops[begin..];
        let mut tracks: BTreeMap<(usize, u64), Vec<(usize, usize)>> = BTreeMap::new();
        let mut part = 0;
        for (k, stop) in stops.iter().enumerate() {
            part += usize::from(stop.begins);
            let features = stop.frame.map_or(&[][..], |i| &recording.frames[i].value.features);
            for (index, feature) in features.iter().enumerate() {
                tracks.entry((part, feature.id)).or_default().push((k, index));
            }
        }
        let mut tracks: Vec<_> = tracks.into_values().filter(|t| t.len() >= FEWEST_SIGHTINGS).collect();
        tracks.sort_by_key(|track| track[0].0);
        let mut open_until = [None; LANDMARKS];
        for track in tracks {
            let (first, last) = (track[0].0, track[track.len() - 1].0);
            let free = open_until.iter().position(|until: &Option<usize>| until.is_none_or(|k| k < first));
            let Some(place) = free else { continue };
            open_until[place] = Some(last);
            self.places = self.places.max(place + 1);
            let landmark = self.landmarks;
            self.landmarks += 1;
            for (k, index) in track {
                stops[k].features.push(FeatureSeen { landmark, place, index });
            }
            stops[last].closes.push((place, landmark));
        }
    }
}

fn nearest(stops: &[Stop], t: MonoTime) -> usize {
    let after = stops.partition_point(|stop| stop.t < t).min(stops.len() - 1);
    let before = after.saturating_sub(1);
    if (t - stops[before].t).abs() < (stops[after].t - t).abs() { before } else { after }
}
