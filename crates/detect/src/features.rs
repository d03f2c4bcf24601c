//! Static ground features followed from frame to frame: corners found where nothing else is, carried to the next frame
//! by pyramidal Lucas–Kanade (Bouguet 2000), then placed where the patch of their first frame is found, also if it is
//! now turned, scaled or slanted ([`Template`]). A feature whose patch is no longer found ends; what is found later at
//! its place is another one, so that no drift adds up within one.

use nalgebra::Vector2;

use super::corners::{Corner, Corners};
use super::flow::Flow;
use super::pyramid::{Base, Pyramid, Rim};
use super::simd::Simd;
use super::template::{Template, Warp};
use windhover_base::msg::{FeatureTrack, ImageView};

/// Least correlation with the patch of a feature's first frame.
const LEAST_CORRELATION: f32 = 0.85;

/// Most that the contrast of a patch changes from one frame to the next, as a factor.
const MOST_GAIN: f32 = 2.0;

/// Largest sigma of a new feature's place for a noise of one grey level, pixels.
const MOST_SIGMA_A_LEVEL: f32 = 0.02;

/// Parts of the frame, across and down; each is to have a feature before any has two.
const PARTS: (usize, usize) = (4, 3);

/// Most features that are followed, moving ones included, as a multiple of the wanted number.
const MOST_MOVING: usize = 2;

const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 1.0];

/// Error that interpolation leaves, pixels.
const LEAST_SIGMA: f32 = 0.03;

/// A feature followed.
#[derive(Clone, Debug)]
struct Track {
    id: u64,
    warp: Warp,
    /// By how much it moved from the frame before, pixels.
    shift: [f32; 2],
    template: Template,
    /// Contrast in the last frame, relative to that in its first frame.
    gain: f32,
    sigma: f32,
    /// Whether it lies on something that moves. It is followed further, so that no new feature is found there.
    moves: bool,
}

/// Maintains a number of features; reuses its buffers.
#[derive(Clone, Debug)]
pub(super) struct FeatureTracker {
    wanted: usize,
    next_id: u64,
    tracks: Vec<Track>,
    /// Size of the frame before.
    size: (usize, usize),
    pyramid: Pyramid,
    before: Pyramid,
    /// Shifts of the features found in this frame.
    shifts: Vec<[f32; 2]>,
    /// Turns of their patches; the whole view turns by about the same.
    turns: Vec<[f32; 4]>,
    /// Turn of the view from frame to frame when it was last measured.
    turn: [f32; 4],
    search: Corners,
    corners: Vec<Corner>,
    simd: Simd,
}

/// A place where no features are wanted: centre and radius, pixels.
pub(super) type Circle = (Vector2<f64>, f64);

/// Places where no features are wanted: circles, and what moves.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Obstacles<'a> {
    pub occupied: &'a [Circle],
    /// Features that were found to lie on something that moves, and the distance that others keep from them, pixels.
    pub moving: &'a [u64],
    pub moving_radius_px: f64,
}

impl FeatureTracker {
    /// Maintains `wanted` features.
    pub fn new(wanted: usize) -> Self {
        Self {
            wanted,
            next_id: 0,
            tracks: Vec::with_capacity(wanted),
            size: (0, 0),
            pyramid: Pyramid::default(),
            before: Pyramid::default(),
            shifts: Vec::with_capacity(wanted),
            turns: Vec::with_capacity(wanted),
            turn: UPRIGHT,
            search: Corners::default(),
            corners: Vec::with_capacity(PARTS.0 * PARTS.1),
            simd: Simd::best(),
        }
    }

    /// Follows the features into a frame and finds new ones away from the obstacles, as replacements of those that
    /// move. A frame of another size than the last starts anew.
    pub fn process(&mut self, image: ImageView<'_>, off: Obstacles<'_>, out: &mut Vec<FeatureTrack>) {
        if self.wanted == 0 {
            return;
        }
        std::mem::swap(&mut self.pyramid, &mut self.before);
        self.pyramid.build(image, Base::Half, Rim::LeftOut, 32, self.simd);
        if self.size == (image.width, image.height) {
            self.follow(image, off.occupied);
        } else {
            self.tracks.clear();
        }
        self.size = (image.width, image.height);
        let most = MOST_MOVING * self.wanted;
        for track in &mut self.tracks {
            track.moves |= off.moving.contains(&track.id);
        }
        if self.still() < self.wanted && self.tracks.len() < most {
            self.find(image, off);
        }
        out.extend(self.tracks.iter().map(|t| FeatureTrack {
            id: t.id,
            px: Vector2::new(f64::from(t.warp.at[0]), f64::from(t.warp.at[1])),
            sigma_px: f64::from(t.sigma.hypot(LEAST_SIGMA)),
        }));
    }

    fn follow(&mut self, image: ImageView<'_>, occupied: &[Circle]) {
        let flow = Flow { from: &self.before, to: &self.pyramid, image };
        let (shifts, turns, turn, simd) = (&mut self.shifts, &mut self.turns, &mut self.turn, self.simd);
        shifts.clear();
        turns.clear();
        self.tracks.retain_mut(|track| {
            let from = track.warp.at;
            let likely = shifts.iter().chain([&track.shift, &[0.0; 2]]);
            let guess = track.warp.moved(flow.carry(from, likely.copied()), turn);
            let Some(found) = track.template.find(image, guess, simd) else { return false };
            let brighter = found.gain / track.gain;
            if found.correlation < LEAST_CORRELATION || brighter.max(1.0 / brighter) > MOST_GAIN {
                return false;
            }
            turns.extend(found.warp.turn_since(&track.warp));
            *turn = middle(turns);
            (track.warp, track.gain, track.sigma) = (found.warp, found.gain, found.sigma);
            track.shift = [track.warp.at[0] - from[0], track.warp.at[1] - from[1]];
            shifts.push(track.shift);
            free(track.warp.at, occupied)
        });
    }

    /// Number of features that are not known to move.
    fn still(&self) -> usize {
        self.tracks.iter().filter(|track| !track.moves).count()
    }

    /// The best corner of each part of the frame that has no feature yet.
    fn find(&mut self, image: ImageView<'_>, off: Obstacles<'_>) {
        let level = self.pyramid.level(image, 2.min(self.pyramid.len() - 1));
        let (w, h) = (level.image.width / PARTS.0, level.image.height / PARTS.1);
        self.corners.clear();
        for (across, down) in (0..PARTS.1).flat_map(|down| (0..PARTS.0).map(move |across| (across, down))) {
            let (u, v) = (across * w, down * h);
            let within = |c: f32, first: usize, length: usize| {
                (first..first + length).contains(&(level.of_frame(c).max(0.0) as usize))
            };
            let here = |t: &Track| within(t.warp.at[0], u, w) && within(t.warp.at[1], v, h);
            if !self.tracks.iter().any(|t| !t.moves && here(t)) {
                let wanted = |at| Template::fits(image, at) && clear(at, &self.tracks, off);
                self.corners.extend(self.search.best(level, (u, v, w, h), self.simd, wanted));
            }
        }
        self.corners.sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
        for &(_, at) in &self.corners {
            if self.still() >= self.wanted || self.tracks.len() >= MOST_MOVING * self.wanted {
                break;
            }
            let Some((template, warp)) = Template::new(image, at, self.simd) else { continue };
            let sigma = template.sigma_a_level();
            if sigma < MOST_SIGMA_A_LEVEL && clear(warp.at, &self.tracks, off) {
                self.tracks.push(Track {
                    id: self.next_id,
                    warp,
                    shift: [0.0; 2],
                    template,
                    gain: 1.0,
                    sigma,
                    moves: false,
                });
                self.next_id += 1;
            }
        }
    }
}

/// The median of each element.
fn middle(turns: &[[f32; 4]]) -> [f32; 4] {
    std::array::from_fn(|k| {
        // The lower of two middle elements: half of the others lie on each side.
        let below = |x: f32| turns.iter().filter(|t| t[k] < x).count();
        let rank = |x: f32| below(x).abs_diff(turns.len() / 2);
        turns.iter().map(|t| t[k]).min_by_key(|x| rank(*x)).unwrap_or(UPRIGHT[k])
    })
}

/// Whether a place is away from all obstacles.
fn clear(at: [f32; 2], tracks: &[Track], off: Obstacles<'_>) -> bool {
    let apart = |track: &Track| f64::from((at[0] - track.warp.at[0]).hypot(at[1] - track.warp.at[1]));
    let beside = |track: &Track| track.moves && apart(track) < off.moving_radius_px;
    free(at, off.occupied) && !tracks.iter().any(beside)
}

fn free(at: [f32; 2], occupied: &[Circle]) -> bool {
    let p = Vector2::new(f64::from(at[0]), f64::from(at[1]));
    occupied.iter().all(|(center, radius)| (p - center).norm() > *radius)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation2, Similarity2};

    use super::*;
    use windhover_base::msg::GrayImage;

    const SIZE: (usize, usize) = (400, 320);

    /// A view of unlimited ground with waves of many lengths and directions: `frame = view · ground`.
    fn frame(view: &Similarity2<f64>, light: f64) -> GrayImage {
        let back = view.inverse();
        let mut image = GrayImage::new(SIZE.0, SIZE.1);
        for (i, level) in image.data.iter_mut().enumerate() {
            let at = back * nalgebra::Point2::new((i % SIZE.0) as f64, (i / SIZE.0) as f64);
            let waves = (0..12).map(|k| {
                let k = f64::from(k);
                let (s, c) = (2.4 * k).sin_cos();
                let length = 5.0 * 1.37_f64.powf(k);
                (std::f64::consts::TAU * (c * at.x + s * at.y) / length + k * k).sin()
            });
            *level = (light * (110.0 + 20.0 * waves.sum::<f64>())).clamp(0.0, 255.0) as u8;
        }
        image
    }

    /// A helicopter that drifts, turns and sinks: the picture moves 6 px, turns 2° and grows 1 % a frame.
    fn view(n: i32) -> Similarity2<f64> {
        let middle = nalgebra::Translation2::new(200.0, 160.0);
        let turned = Rotation2::new(f64::from(2 * n).to_radians());
        let grown = Similarity2::from_parts(
            nalgebra::Translation2::identity(),
            nalgebra::UnitComplex::from_rotation_matrix(&turned),
            1.01_f64.powi(n),
        );
        nalgebra::Translation2::new(6.0 * f64::from(n), -2.0 * f64::from(n))
            * (middle * grown * middle.inverse())
    }

    #[test]
    fn features_stay_on_their_ground_however_the_view_turns() {
        let mut tracker = FeatureTracker::new(8);
        let mut births: Vec<(u64, nalgebra::Point2<f64>, i32)> = Vec::new();
        let (mut longest, mut n_held) = (0, 0);
        for n in 0..24 {
            let light = 1.0 - 0.01 * f64::from(n);
            let mut out = Vec::new();
            tracker.process(frame(&view(n), light).view(), Obstacles::default(), &mut out);
            assert_eq!(out.len(), 8, "frame {n}");
            for track in &out {
                let ground = view(n).inverse() * nalgebra::Point2::from(track.px);
                match births.iter().find(|b| b.0 == track.id) {
                    Some((_, born, since)) => {
                        let off = (view(n) * born - view(n) * ground).norm();
                        assert!(off < 0.15, "feature {} is off by {off:.2} px in frame {n}", track.id);
                        longest = longest.max(n - since);
                        n_held += 1;
                    }
                    None => births.push((track.id, ground, n)),
                }
            }
        }
        assert!(longest >= 20, "the longest lived {longest} frames");
        assert!(n_held > 100, "{n_held} sightings of features already known");
    }

    #[test]
    fn a_cut_ends_every_feature() {
        let mut tracker = FeatureTracker::new(8);
        let (mut before, mut after) = (Vec::new(), Vec::new());
        tracker.process(frame(&view(0), 1.0).view(), Obstacles::default(), &mut before);
        let elsewhere = nalgebra::Translation2::new(5000.0, 3000.0) * view(0);
        tracker.process(frame(&elsewhere, 1.0).view(), Obstacles::default(), &mut after);
        assert_eq!((before.len(), after.len()), (8, 8));
        assert!(after.iter().all(|a| before.iter().all(|b| b.id != a.id)), "all are new");
    }

    #[test]
    fn occupied_places_are_kept_clear() {
        let mut tracker = FeatureTracker::new(8);
        let circle = (Vector2::new(200.0, 160.0), 100.0);
        for n in 0..4 {
            let mut out = Vec::new();
            let off = Obstacles { occupied: &[circle], ..Obstacles::default() };
            tracker.process(frame(&view(n), 1.0).view(), off, &mut out);
            assert!(!out.is_empty() && out.iter().all(|t| (t.px - circle.0).norm() > circle.1), "frame {n}");
        }
    }

    #[test]
    fn others_are_found_in_the_place_of_what_moves_and_keep_off_it() {
        let mut tracker = FeatureTracker::new(8);
        let mut out = Vec::new();
        tracker.process(frame(&view(0), 1.0).view(), Obstacles::default(), &mut out);
        // Two in the middle, which stay in view.
        out.sort_by_key(|track| (track.px - Vector2::new(200.0, 160.0)).norm() as u32);
        let moving = [out[0].id, out[1].id];
        for n in 1..6 {
            let off = Obstacles { moving: &moving, moving_radius_px: 60.0, ..Obstacles::default() };
            out.clear();
            tracker.process(frame(&view(n), 1.0).view(), off, &mut out);
            let (movers, still): (Vec<&FeatureTrack>, Vec<&FeatureTrack>) =
                out.iter().partition(|track| moving.contains(&track.id));
            assert_eq!(movers.len(), 2, "they are followed on");
            assert!(still.len() >= 7, "{} others in frame {n}", still.len());
            // The first eight had the numbers below eight.
            for new in still.iter().filter(|track| n == 1 && track.id >= 8) {
                assert!(movers.iter().all(|mover| (new.px - mover.px).norm() >= 60.0), "{new:?}");
            }
        }
    }
}
