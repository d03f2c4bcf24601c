//! Motion of helicopter and targets from one knot to the next.
//!
//! Real motion is smooth. Each angle of the helicopter is a chain (angle, rate, acceleration) that is driven by white
//! noise; a target's distance along its course, and its heading, are chains of four (distance, speed, acceleration,
//! jerk). The last elements have a finite correlation time: acceleration of some seconds (Singer 1970), a target's jerk
//! of the response time of its drive and steering. With the chain's matrix A, over the interval h of two knots
//!
//! `x' = e^(A h) x + w`, `cov w = q ∫₀ʰ e^(A s) b bᵀ e^(Aᵀ s) ds`.
//!
//! The helicopter's position and velocity follow its acceleration a, the filter's own model of thrust, wind and drag:
//! `v' = v + h/2 (a + a')`, `p' = p + h/2 (v + v') − h²/12 (a' − a)`.

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::{skew, wrap_angle};

use windhover_estimate::batch::{SWAY_COLUMNS, SWAY_TAU_S};

use crate::block::{Block, Noise, Source};
use crate::front::Shape;
use crate::unknowns::{Place, knot};
use crate::values::Knot;

/// Correlation times of the elements of a chain, s: the helicopter's angle, rate, angular acceleration.
const SPIN: [f64; 3] = [f64::INFINITY, f64::INFINITY, 1.0];
/// The same for a target's distance or heading, its rate, acceleration and jerk.
const DRIVE: [f64; 4] = [f64::INFINITY, f64::INFINITY, 2.0, 0.4];
/// Slow force of the wind, m/s² per √s.
const WIND_WALK: f64 = 0.1;
/// Least variance of a step, m² or rad²: with a smaller one the absolute position is lost to rounding.
const LEAST_VAR: f64 = 1e-13;
/// Walk of place and heading of a target that does not move, m²/s and rad²/s: with a smaller one the absolute place is lost to
/// rounding.
const STILL_Q: f64 = 1e-9;

/// Constants of processes that are not fitted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Processes {
    pub(crate) gust_tau_s: f64,
    pub(crate) thrust_tau_s: f64,
    /// Variance, rad², and correlation time, s.
    pub(crate) tilt_error: (f64, f64),
    /// Variances, m², and correlation time, s.
    pub(crate) gps_bias: ([f64; 3], f64),
    pub(crate) slip_q: f64,
}

/// Acceleration of a knot with its derivatives, by the filter's columns.
pub(crate) type Pushed = (Vector3<f64>, [(usize, Vector3<f64>); 14]);

/// Two neighbouring knots.
pub(crate) struct Link<'a> {
    pub(crate) from: &'a Knot,
    pub(crate) to: &'a Knot,
    pub(crate) pushed: (&'a Pushed, &'a Pushed),
    pub(crate) h: f64,
    /// InitialValues columns of the two.
    pub(crate) at: (usize, usize),
    pub(crate) shape: Shape,
    pub(crate) places: &'a [Place],
    pub(crate) noise: &'a Noise,
    /// Window of time for the factors of motion.
    pub(crate) window: usize,
    pub(crate) processes: &'a Processes,
}

/// A chain, in which each element is the derivative of the previous one, over a step.
struct Chain<const N: usize> {
    /// `e^(A h)`.
    transition: [[f64; N]; N],
    /// Of unit intensity, row by row.
    covariance: Vec<f64>,
}

/// Nodes and weights of Gauss's quadrature with five points over (−1, 1).
const GAUSS: [(f64, f64); 5] = [
    (0.0, 0.568_888_888_888_888_9),
    (-0.538_469_310_105_683, 0.478_628_670_499_366_5),
    (0.538_469_310_105_683, 0.478_628_670_499_366_5),
    (-0.906_179_845_938_664, 0.236_926_885_056_189_1),
    (0.906_179_845_938_664, 0.236_926_885_056_189_1),
];

impl<const N: usize> Chain<N> {
    fn new(h: f64, memories_s: &[f64; N]) -> Self {
        let mut covariance = vec![0.0; N * N];
        for (node, weight) in GAUSS {
            let s = 0.5 * h * (1.0 + node);
            let driven = exponential(s, memories_s).map(|row| row[N - 1]);
            for i in 0..N {
                (0..N).for_each(|j| covariance[i * N + j] += 0.5 * h * weight * driven[i] * driven[j]);
            }
        }
        Self { transition: exponential(h, memories_s), covariance }
    }
}

/// `e^(A s)` by its series, with `A` of a chain: `(A x)_i = x_(i+1) − x_i/τ_i`.
fn exponential<const N: usize>(s: f64, memories_s: &[f64; N]) -> [[f64; N]; N] {
    let mut sum: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(i == j)));
    let mut term = sum;
    for k in 1..TERMS {
        let by = s / f64::from(k);
        term = std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                let next = if i + 1 < N { term[i + 1][j] } else { 0.0 };
                by * (next - term[i][j] / memories_s[i])
            })
        });
        (0..N).for_each(|i| (0..N).for_each(|j| sum[i][j] += term[i][j]));
    }
    sum
}

/// Terms of the series: a step is a fraction of every memory.
const TERMS: u32 = 14;

impl Link<'_> {
    /// Passes on every block of the step.
    pub(crate) fn blocks(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        self.path(block, take);
        self.attitude(block, take);
        let p = self.processes;
        let gust = 1.0 - (-2.0 * self.h / p.gust_tau_s).exp();
        self.reverting(knot::GUST, &[gust; 2], p.gust_tau_s, Source::Gust, block, take);
        let thrust = 1.0 - (-2.0 * self.h / p.thrust_tau_s).exp();
        self.reverting(knot::THRUST, &[thrust], p.thrust_tau_s, Source::Thrust, block, take);
        let (var, tau_s) = p.tilt_error;
        let grown = var * (1.0 - (-2.0 * self.h / tau_s).exp());
        self.reverting(knot::TILT_ERROR, &[grown; 2], tau_s, Source::Known, block, take);
        self.reverting(
            knot::WIND,
            &[WIND_WALK.powi(2) * self.h; 2],
            f64::INFINITY,
            Source::Known,
            block,
            take,
        );
        let (vars, tau_s) = p.gps_bias;
        let grown = vars.map(|var| var * (1.0 - (-2.0 * self.h / tau_s).exp()));
        self.reverting(knot::GPS_BIAS, &grown, tau_s, Source::Known, block, take);
    }

    /// Position and velocity of the helicopter.
    fn path(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        let (h, (from, to)) = (self.h, (self.from, self.to));
        let (a, b) = (&self.pushed.0.0, &self.pushed.1.0);
        let (va, vb) = (from.three(knot::VELOCITY), to.three(knot::VELOCITY));
        let place = to.three(knot::POSITION) - from.three(knot::POSITION) - (va + vb) * (0.5 * h)
            + (b - a) * (h * h / 12.0);
        let velocity = vb - va - (a + b) * (0.5 * h);
        block.begin(6);
        let ends = [self.at.0, self.at.1];
        let own = |at: usize| {
            (knot::POSITION..knot::POSITION + 3)
                .chain(knot::VELOCITY..knot::VELOCITY + 3)
                .map(move |i| at + i)
        };
        let pushed = [self.pushed.0, self.pushed.1];
        let forces: Vec<(usize, usize, Vector3<f64>)> = (0..2)
            .flat_map(|end| {
                pushed[end].1.iter().filter_map(move |(c, d)| Some((end, self.column(end, *c)?, *d)))
            })
            .collect();
        block.over(own(ends[0]).chain(own(ends[1])).chain(forces.iter().map(|(_, column, _)| *column)));
        for i in 0..3 {
            (block.right[i], block.right[3 + i]) = (-place[i], -velocity[i]);
            for (end, sign) in [(0, -1.0), (1, 1.0)] {
                *block.at(i, 6 * end + i) = sign;
                *block.at(i, 6 * end + 3 + i) = -0.5 * h;
                *block.at(3 + i, 6 * end + 3 + i) = sign;
            }
            for (k, (end, _, d)) in forces.iter().enumerate() {
                let sign = if *end == 0 { -1.0 } else { 1.0 };
                *block.at(i, 12 + k) = sign * h * h / 12.0 * d[i];
                *block.at(3 + i, 12 + k) = -0.5 * h * d[i];
            }
        }
        let q = self.noise.of(Source::Vibration);
        let sigma = [(q * h.powi(3) / 12.0).sqrt(), (q * h).sqrt()];
        let width = block.columns.len();
        for row in 0..6 {
            let by = 1.0 / sigma[row / 3];
            block.right[row] *= by;
            block.rows[row * width..][..width].iter_mut().for_each(|x| *x *= by);
        }
        take(Source::Vibration, block);
    }

    /// Place of one of the filter's columns, at either end; `None` where it is known.
    fn column(&self, end: usize, column: usize) -> Option<usize> {
        let at = if end == 0 { self.at.0 } else { self.at.1 };
        match self.places[column] {
            Place::Knot(i) => Some(at + i),
            Place::Constant(i) => Some(self.shape.constants_at() + i),
            Place::Landmark(_) | Place::Shake(_) | Place::Known(_) | Place::Nowhere => None,
        }
    }

    /// Attitude, rate and angular acceleration, for one axis of the body after another.
    fn attitude(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        let (from, to, chain) = (self.from, self.to, Chain::new(self.h, &SPIN));
        let turn = (from.attitude.inverse() * to.attitude).scaled_axis();
        let bend = skew(&(turn * 0.5));
        let by_to = (Matrix3::identity() + bend) * to.attitude.matrix().transpose();
        let by_from = -(Matrix3::identity() - bend) * from.attitude.matrix().transpose();
        let (rate, spin) = (from.three(knot::RATE), from.three(knot::SPIN));
        let (rate_to, spin_to) = (to.three(knot::RATE), to.three(knot::SPIN));
        for axis in 0..3 {
            let source = if axis < 2 { Source::TiltMotion } else { Source::YawMotion };
            block.begin(3);
            let own = |at: usize| {
                (0..3)
                    .map(move |i| at + knot::ATTITUDE + i)
                    .chain([at + knot::RATE + axis, at + knot::SPIN + axis])
            };
            block.over(own(self.at.0).chain(own(self.at.1)));
            for i in 0..3 {
                *block.at(0, i) = by_from[(axis, i)];
                *block.at(0, 5 + i) = by_to[(axis, i)];
            }
            let states = ([0.0, rate[axis], spin[axis]], [turn[axis], rate_to[axis], spin_to[axis]]);
            set_chain(block, &[None, Some(3), Some(4)], &[None, Some(8), Some(9)], &chain, &states);
            self.finish(block, &chain.covariance, source, take);
        }
    }

    /// A quantity that reverts to zero, or a random walk: each component separately.
    fn reverting(
        &self,
        first: usize,
        grown: &[f64],
        tau_s: f64,
        source: Source,
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let kept = (-self.h / tau_s).exp();
        for (i, grown) in grown.iter().enumerate() {
            block.begin(1);
            block.over([self.at.0 + first + i, self.at.1 + first + i]);
            (*block.at(0, 0), *block.at(0, 1)) = (-kept, 1.0);
            block.right[0] = -(self.to.x[first + i] - kept * self.from.x[first + i]);
            self.finish(block, &[*grown], source, take);
        }
    }

    /// A target: along its course, in its heading, and across (side slip).
    pub(crate) fn target(
        &self,
        target: usize,
        moves: bool,
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let (a, b) = (self.from.target(target), self.to.target(target));
        let at = [self.at.0 + knot::target(target), self.at.1 + knot::target(target)];
        if !moves {
            return self.still(a, b, at, block, take);
        }
        let chain = Chain::new(self.h, &DRIVE);
        let turned = wrap_angle(b[knot::HEADING] - a[knot::HEADING]);
        let (s, c) = (a[knot::HEADING] + 0.5 * turned).sin_cos();
        let (north, east) = (b[0] - a[0], b[1] - a[1]);
        let (along, across) = (c * north + s * east, c * east - s * north);
        // Along the course.
        let links = [knot::SPEED, knot::ACCELERATION, knot::JERK];
        block.begin(4);
        let of = |at: usize| {
            [0, 1, knot::HEADING, knot::SPEED, knot::ACCELERATION, knot::JERK].map(move |i| at + i)
        };
        block.over(of(at[0]).into_iter().chain(of(at[1])));
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            *block.at(0, 6 * end) = sign * c;
            *block.at(0, 6 * end + 1) = sign * s;
            *block.at(0, 6 * end + 2) = 0.5 * across;
        }
        let states = (chained(0.0, a, links), chained(along, b, links));
        let (from, to) = ([None, Some(3), Some(4), Some(5)], [None, Some(9), Some(10), Some(11)]);
        set_chain(block, &from, &to, &chain, &states);
        self.finish(block, &chain.covariance, Source::Drive(target), take);
        // Heading.
        let links = [knot::YAW_RATE, knot::YAW_ACCELERATION, knot::YAW_JERK];
        block.begin(4);
        let of = |at: usize| {
            [knot::HEADING, knot::YAW_RATE, knot::YAW_ACCELERATION, knot::YAW_JERK].map(move |i| at + i)
        };
        block.over(of(at[0]).into_iter().chain(of(at[1])));
        let states = (chained(0.0, a, links), chained(turned, b, links));
        set_chain(block, &[0, 1, 2, 3].map(Some), &[4, 5, 6, 7].map(Some), &chain, &states);
        self.finish(block, &chain.covariance, Source::Turn(target), take);
        // Across.
        block.begin(1);
        block.over([0, 1].into_iter().flat_map(|end| [0, 1, knot::HEADING].map(|i| at[end] + i)));
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            *block.at(0, 3 * end) = -sign * s;
            *block.at(0, 3 * end + 1) = sign * c;
            *block.at(0, 3 * end + 2) = -0.5 * along;
        }
        block.right[0] = -across;
        self.finish(block, &[self.processes.slip_q * self.h], Source::Slip(target), take);
    }

    /// Sway of a target on its springs, with markers so high, m: each of its angles and heave reverts to zero.
    pub(crate) fn sway(
        &self,
        target: usize,
        height_m: f64,
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let grown = 1.0 - (-2.0 * self.h / SWAY_TAU_S).exp();
        let of_unit = sway_variances(height_m);
        for (i, source) in sway_sources(target).into_iter().enumerate() {
            let first = knot::target(target) + knot::SWAY + i;
            self.reverting(first, &[grown * of_unit[i]], SWAY_TAU_S, source, block, take);
        }
    }

    /// A target that does not move: its place and heading. Its speed and yaw rate are zero at every knot.
    fn still(
        &self,
        a: &[f64],
        b: &[f64],
        at: [usize; 2],
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        for i in 0..=knot::HEADING {
            block.begin(1);
            block.over([at[0] + i, at[1] + i]);
            (*block.at(0, 0), *block.at(0, 1)) = (-1.0, 1.0);
            let change = b[i] - a[i];
            block.right[0] = -if i == knot::HEADING { wrap_angle(change) } else { change };
            self.finish(block, &[STILL_Q * self.h], Source::Known, take);
        }
    }

    fn finish(
        &self,
        block: &mut Block,
        covariance: &[f64],
        source: Source,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let figure = self.noise.at(source, self.window);
        let mut covariance: Vec<f64> = covariance.iter().map(|c| c * figure).collect();
        covariance[0] += LEAST_VAR;
        if block.whiten(&mut covariance) {
            take(source, block);
        }
    }
}

/// Variances of roll, pitch (rad²) and heave (m²) that displace markers so high by 1 m², each.
pub(crate) fn sway_variances(height_m: f64) -> [f64; SWAY_COLUMNS] {
    let angle = height_m.powi(-2);
    [angle, angle, 1.0]
}

/// Sources of roll, pitch and heave.
pub(crate) const fn sway_sources(target: usize) -> [Source; SWAY_COLUMNS] {
    [Source::Sway(target), Source::Sway(target), Source::Heave(target)]
}

/// A chain's state: its first element, and the others from a target's part.
fn chained(first: f64, target: &[f64], links: [usize; 3]) -> [f64; 4] {
    [first, target[links[0]], target[links[1]], target[links[2]]]
}

/// Writes a chain's rows: derivatives with respect to the elements at either end, by the places of their columns
/// (`None` where they are set elsewhere), and the residuals of the states. The first element is relative to its value
/// at the first end.
fn set_chain<const N: usize>(
    block: &mut Block,
    from: &[Option<usize>; N],
    to: &[Option<usize>; N],
    chain: &Chain<N>,
    states: &([f64; N], [f64; N]),
) {
    for row in 0..N {
        let mut expected = 0.0;
        for link in 0..N {
            let by = chain.transition[row][link];
            expected += by * states.0[link];
            if let Some(place) = from[link] {
                *block.at(row, place) = -by;
            }
            if let Some(place) = to[link] {
                *block.at(row, place) = f64::from(row == link);
            }
        }
        block.right[row] = expected - states.1[row];
    }
}
