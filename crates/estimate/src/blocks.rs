//! Which part of the joint state lies in which columns of the error state.
//!
//! Order: the helicopter and its sensors' slow errors ([`own`], as many as there are sensors), each target
//! ([`TargetBlock`]), each ground feature (two columns), each fitted tag ([`TagFitBlock`]), the sway of each target, the vibration of a frame. A new state of the helicopter is a
//! constant of [`own`].

use std::ops::Range;

use nalgebra::SVector;

/// `N` neighbouring columns of the error state.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Block<const N: usize>(usize);

impl<const N: usize> Block<N> {
    /// The first columns of all.
    pub(crate) const FIRST: Self = Self(0);

    /// The columns right behind another block.
    pub(crate) const fn after<const M: usize>(before: Block<M>) -> Self {
        Self(before.end())
    }

    /// The `N` columns from the first of another block on.
    pub(crate) const fn from_start_of<const M: usize>(first: Block<M>) -> Self {
        Self(first.0)
    }

    /// The column of component `i`.
    pub(crate) const fn column(self, i: usize) -> usize {
        debug_assert!(i < N);
        self.0 + i
    }

    /// The column behind its last one.
    pub(crate) const fn end(self) -> usize {
        self.0 + N
    }

    /// Its columns.
    pub(crate) const fn range(self) -> Range<usize> {
        self.0..self.end()
    }

    /// `M` of its columns, from component `i` on.
    pub(crate) const fn part<const M: usize>(self, i: usize) -> Block<M> {
        debug_assert!(i + M <= N);
        Block(self.0 + i)
    }

    /// Its part of a row of the error state's length.
    pub(crate) fn of(self, row: &[f64]) -> SVector<f64, N> {
        SVector::from_column_slice(&row[self.range()])
    }
}

/// The helicopter's part.
pub(crate) mod own {
    use super::Block;

    /// Position of the body frame's origin, NED, m.
    pub(crate) const POSITION: Block<3> = Block::FIRST;
    /// Its velocity, NED, m/s.
    pub(crate) const VELOCITY: Block<3> = Block::after(POSITION);
    /// Attitude error: small rotation about the NED axes, `R = exp(δ) R̂`, rad.
    pub(crate) const ATTITUDE: Block<3> = Block::after(VELOCITY);
    /// Its vertical component: the error of absolute heading.
    pub(crate) const TURN: Block<1> = ATTITUDE.part(2);
    /// Angular rate in the body frame, rad/s.
    pub(crate) const RATE: Block<3> = Block::after(ATTITUDE);
    /// Gusts: force over mass, NED horizontal, m/s².
    pub(crate) const GUST: Block<2> = Block::after(RATE);
    /// Thrust beyond the weight, along the vertical, m/s².
    pub(crate) const THRUST: Block<1> = Block::after(GUST);
    /// Slow error of the tilt reading (pitch, roll), rad.
    pub(crate) const TILT_ERROR: Block<2> = Block::after(THRUST);
    /// Slow force of the wind over mass, NED horizontal, m/s².
    pub(crate) const WIND: Block<2> = Block::after(TILT_ERROR);
    /// Trim: the thrust's direction in the body is against (ε1, ε2, 1).
    pub(crate) const TRIM: Block<2> = Block::after(WIND);
    /// GPS position bias, NED, m.
    pub(crate) const GPS_BIAS: Block<3> = Block::after(TRIM);
    /// Compass heading bias, rad.
    pub(crate) const HEADING_BIAS: Block<1> = Block::after(GPS_BIAS);
    /// How much of what it feels the tilt sensor reads.
    pub(crate) const TILT_GAIN: Block<1> = Block::after(HEADING_BIAS);
    /// Tilt bias (pitch, roll), rad.
    pub(crate) const TILT_BIAS: Block<2> = Block::after(TILT_GAIN);
    /// How much older positions of the receiver are than configured, s.
    pub(crate) const GPS_DELAY: Block<1> = Block::after(TILT_BIAS);
    /// Drag: acceleration per metre a second over the ground, 1/s. What the wind adds is [`WIND`].
    pub(crate) const DRAG: Block<1> = Block::after(GPS_DELAY);
    /// How much older the compass is than configured, against the camera, s.
    pub(crate) const COMPASS_DELAY: Block<1> = Block::after(DRAG);

    /// By how much the antenna is elsewhere than configured, body axes forward and right, m.
    pub(crate) const ARM: Block<2> = Block::after(COMPASS_DELAY);

    /// Errors of the lens's distortion: k1, k2, p1, p2.
    pub(crate) const LENS: Block<4> = Block::after(ARM);

    /// How much longer than configured the camera takes from its first row to its last, s.
    pub(crate) const READOUT: Block<1> = Block::after(LENS);

    /// Time constant of the low-pass that the receiver applies to velocity, s.
    pub(crate) const VELOCITY_DELAY: Block<1> = Block::after(READOUT);

    /// Constant error of the gyros, body axes, rad/s. From here on only where there is an IMU.
    pub(crate) const RATE_BIAS: Block<3> = Block::after(VELOCITY_DELAY);
    /// Constant error of the accelerometers, body axes, m/s².
    pub(crate) const FORCE_BIAS: Block<3> = Block::after(RATE_BIAS);
    /// Heading bias of the second source of attitude, rad. From here on only where there is one.
    pub(crate) const SECOND_HEADING_BIAS: Block<1> = Block::after(FORCE_BIAS);
    /// How much of what it feels its tilt sensor reads.
    pub(crate) const SECOND_TILT_GAIN: Block<1> = Block::after(SECOND_HEADING_BIAS);
    /// Its tilt bias (pitch, roll), rad.
    pub(crate) const SECOND_TILT_BIAS: Block<2> = Block::after(SECOND_TILT_GAIN);
    /// Slow error of its tilt reading, rad.
    pub(crate) const SECOND_TILT_ERROR: Block<2> = Block::after(SECOND_TILT_BIAS);

    /// What has intensities that are fitted in flight: rate, gusts, thrust, error of the tilt reading.
    pub(crate) const MOTION: Block<{ TILT_ERROR.end() - ATTITUDE.end() }> = Block::from_start_of(RATE);
    /// Length of the helicopter's part with GPS and compass only, with an IMU, and with a second source of attitude.
    pub(crate) const LEN: usize = VELOCITY_DELAY.end();
    pub(crate) const WITH_IMU: usize = FORCE_BIAS.end();
    pub(crate) const WITH_SECOND: usize = SECOND_TILT_ERROR.end();
    /// What moves by itself, forces and slow errors: the table of `slow.rs`.
    pub(crate) const SLOW: Block<{ WITH_SECOND - RATE.end() }> = Block::after(RATE);
    /// The sensors' slow errors and drag, which outlive a restart.
    pub(crate) const SENSORS: Block<{ DRAG.end() - TRIM.end() }> = Block::after(TRIM);
}

/// Length of a target's part.
pub(crate) const TARGET: usize = 5;
/// Length of a feature's part: north, east.
pub(crate) const FEATURE: usize = 2;

/// Length of a vehicle's sway: roll, pitch, heave of its body.
pub(crate) const SWAY: usize = 3;

/// Rows of a frame at which its vibration is a state, and length of its part: displacements along x and y, roll.
pub(crate) const SHAKE_NODES: usize = 6;
pub(crate) const SHAKE: usize = 2 * SHAKE_NODES + 1;

/// Length of a tag's part: logarithm of its size, place forward and right, turn, each beside its configuration.
pub(crate) const TAG_FIT: usize = 4;

/// One tag's part.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct TagFitBlock(Block<TAG_FIT>);

impl TagFitBlock {
    /// All of it.
    pub(crate) const fn all(self) -> Block<TAG_FIT> {
        self.0
    }
}

/// One target's part: north, east, heading, speed, yaw rate of the rear axle.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct TargetBlock(Block<TARGET>);

impl TargetBlock {
    /// Where target `i` lies in a state that holds nothing but targets, as a delayed copy does.
    pub(crate) const fn alone(i: usize) -> Self {
        Self(Block(TARGET * i))
    }

    /// All of it.
    pub(crate) const fn all(self) -> Block<TARGET> {
        self.0
    }

    /// North and east of the rear axle, m.
    pub(crate) const fn place(self) -> Block<2> {
        self.0.part(0)
    }

    /// North, east, heading.
    pub(crate) const fn pose(self) -> Block<3> {
        self.0.part(0)
    }

    /// Heading, rad.
    pub(crate) const fn heading(self) -> Block<1> {
        self.0.part(2)
    }

    /// Speed of the rear axle, m/s.
    pub(crate) const fn speed(self) -> Block<1> {
        self.0.part(3)
    }

    /// Yaw rate, rad/s.
    pub(crate) const fn yaw_rate(self) -> Block<1> {
        self.0.part(4)
    }

    /// Speed and yaw rate, the two that walk.
    pub(crate) const fn motion(self) -> Block<2> {
        self.0.part(3)
    }
}

/// Where each part of a state of so many targets and features lies.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) struct Layout {
    /// Length of the helicopter's part: `own::LEN` or longer.
    pub(crate) own: usize,
    pub(crate) targets: usize,
    pub(crate) features: usize,
    /// Tags whose size, place and turn are states.
    pub(crate) tags: usize,
}

impl Layout {
    /// Length of the error state.
    pub(crate) const fn len(self) -> usize {
        self.shake().end()
    }

    /// The states of the helicopter's part that move by themselves.
    pub(crate) const fn slow(self) -> Range<usize> {
        own::SLOW.column(0)..self.own
    }

    /// Target `i`.
    pub(crate) const fn target(self, i: usize) -> TargetBlock {
        TargetBlock(Block(self.own + TARGET * i))
    }

    /// Feature `i`.
    pub(crate) const fn feature(self, i: usize) -> Block<FEATURE> {
        Block(self.own + TARGET * self.targets + FEATURE * i)
    }

    /// The fit of tag `i`.
    pub(crate) const fn tag(self, i: usize) -> TagFitBlock {
        TagFitBlock(Block(self.feature(self.features).0 + TAG_FIT * i))
    }

    /// The sway of target `i`.
    pub(crate) const fn sway(self, i: usize) -> Block<SWAY> {
        Block(self.tag(self.tags).0.0 + SWAY * i)
    }

    /// The vibration of the frame at hand.
    pub(crate) const fn shake(self) -> Block<SHAKE> {
        Block(self.sway(self.targets).0)
    }

    /// Every pair of columns that is a place on the ground: of targets, then of features.
    pub(crate) fn places(self) -> impl Iterator<Item = Block<2>> {
        let targets = (0..self.targets).map(move |i| self.target(i).place());
        targets.chain((0..self.features).map(move |i| self.feature(i)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_of_a_state_lie_one_behind_the_other() {
        let layout = Layout { own: own::LEN, targets: 2, features: 3, tags: 2 };
        assert_eq!(own::MOTION.range(), own::RATE.column(0)..own::TILT_ERROR.end());
        assert_eq!(layout.slow(), own::GUST.column(0)..own::LEN);
        assert_eq!(own::SLOW.end(), own::WITH_SECOND);
        assert_eq!(own::SENSORS.range(), own::GPS_BIAS.column(0)..own::DRAG.end());
        assert_eq!(layout.target(0).all().column(0), own::LEN);
        assert_eq!(layout.target(1).all().column(0), layout.target(0).yaw_rate().end());
        assert_eq!(layout.feature(0).column(0), layout.target(1).all().end());
        assert_eq!(layout.feature(2).end(), layout.tag(0).all().column(0));
        assert_eq!(layout.tag(1).all().end(), layout.sway(0).column(0));
        assert_eq!(layout.sway(1).end(), layout.shake().column(0));
        assert_eq!(layout.shake().end(), layout.len());
        let places: Vec<_> = layout.places().map(Block::range).collect();
        assert_eq!(places.len(), 5);
        assert_eq!(places[4].end, layout.tag(0).all().column(0));
    }
}
