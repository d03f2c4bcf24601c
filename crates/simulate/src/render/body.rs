//! Vehicles as the camera sees them: a box, and marker plates above it.

use nalgebra::{Matrix3, Vector3};

use super::super::company::Appearance;
use windhover_base::settings::{Brightness, MarkerConfig, MarkerKind, TargetConfig};
use windhover_detect::{TagLayout, TagPattern, tag_pattern};

/// Grey levels of printed white and black, of a body, its windscreen and its sides in full light.
const WHITE: f32 = 222.0;
const BLACK: f32 = 22.0;
const BODY: f32 = 70.0;
const LIGHT_BODY: f32 = 160.0;
const WINDSCREEN: f32 = 26.0;
const SIDES: f32 = 44.0;
/// And of what lies on a marker.
const COVER: f32 = 96.0;

/// Darkest and lightest of clothes and painted roofs.
const PAINTED: (f32, f32) = (25.0, 210.0);

/// Markers of one vehicle that may be covered.
const COVERABLE: usize = 8;

/// What a ray meets.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) enum Hit {
    /// A surface of a vehicle of this grey level, at this distance along the ray.
    Surface { level: f32, at: f32 },
    /// The ground, lit or in a vehicle's shadow.
    Ground { shadow: bool },
}

impl Hit {
    /// Two points of one class look alike, but for the ground's picture.
    pub(super) fn class(self) -> u32 {
        match self {
            Self::Ground { shadow } => u32::from(shadow),
            Self::Surface { level, .. } => 2 + level as u32,
        }
    }
}

/// Clothes and painted roofs: cubes of random grey through the whole body.
#[derive(Clone, Copy, Debug)]
struct Paint {
    per_m: f32,
    seed: u32,
}

impl Paint {
    fn level(self, at: &Vector3<f32>) -> f32 {
        // A face lies on a cube's border as often as not: looked at a little inside of it.
        let cell = at.map(|x| (x * self.per_m * 0.999 + 0.013).floor() as i32 as u32);
        let mut mixed = self.seed.wrapping_mul(0x9e37_79b9);
        for part in cell.iter() {
            mixed = (mixed ^ part).wrapping_mul(0x85eb_ca6b);
            mixed ^= mixed >> 15;
        }
        PAINTED.0 + (PAINTED.1 - PAINTED.0) * (mixed & 0xffff) as f32 / 65_535.0
    }
}

/// A marker plate in the vehicle frame.
#[derive(Clone, Debug)]
struct Plate {
    centre: Vector3<f32>,
    /// Direction of the plate's top and right, (forward, right) components.
    top: (f32, f32),
    half: f32,
    face: Face,
}

#[derive(Clone, Debug)]
enum Face {
    Tag(TagPattern),
    Disc(f32),
}

/// One vehicle's shape.
#[derive(Clone, Debug)]
pub(super) struct Body {
    plates: Vec<Plate>,
    /// Corners of the box, forward-right-down; `None` for a marker on the ground.
    hull: Option<(Vector3<f32>, Vector3<f32>)>,
    level: f32,
    windscreen: (f32, f32),
    paint: Option<Paint>,
}

impl Body {
    pub(super) fn new(target: &TargetConfig) -> Self {
        let plates: Vec<_> = target.marker.iter().map(Plate::new).collect();
        let heights = plates.iter().map(|p| -p.centre.z);
        let height = heights.fold(f32::INFINITY, f32::min);
        let length = target.wheelbase_m.unwrap_or(0.8) as f32;
        let fold = |start: f32, pick: fn(f32, f32) -> f32, sign: f32| {
            plates.iter().map(|p| p.centre.x + sign * 1.35 * p.half).fold(start, pick)
        };
        let aft = fold(-0.25 * length, f32::min, -1.0);
        let fore = fold(1.25 * length, f32::max, 1.0) + 0.12 * length;
        let wide = plates.iter().map(|p| p.centre.y.abs() + 1.35 * p.half).fold(0.36 * length, f32::max);
        let hull = (height.is_finite() && height > 0.05)
            .then(|| (Vector3::new(aft, -wide, -(height - 0.005)), Vector3::new(fore, wide, 0.0)));
        let dark_disc = target
            .marker
            .iter()
            .any(|m| m.kind == MarkerKind::Disc && disc_level(m) < f32::midpoint(BODY, LIGHT_BODY));
        let level = if dark_disc { LIGHT_BODY } else { BODY };
        let windscreen = (fore - 0.10 * length, fore - 0.02 * length);
        Self { plates, hull, level, windscreen, paint: None }
    }

    /// What companion `index` looks like, beside vehicles like `target`.
    pub(super) fn of_companion(looks: Appearance, target: &TargetConfig, index: usize) -> Self {
        let paint = |cell_m: f32| Some(Paint { per_m: 1.0 / cell_m, seed: 1 + index as u32 });
        match looks {
            Appearance::Double => Self::new(target),
            Appearance::Painted => {
                let bare = Self::new(&TargetConfig { marker: Vec::new(), ..target.clone() });
                let length = target.wheelbase_m.unwrap_or(0.8) as f32;
                Self {
                    paint: paint(0.12),
                    ..bare.of_size((-0.35 * length, 1.45 * length), 0.43 * length, 0.55)
                }
            }
            Appearance::Person => {
                let bare = Self::new(&TargetConfig { marker: Vec::new(), ..target.clone() });
                Self { paint: paint(0.08), ..bare.of_size((-0.17, 0.17), 0.24, 1.7) }
            }
        }
    }

    fn of_size(self, (aft, fore): (f32, f32), wide: f32, height: f32) -> Self {
        let hull = Some((Vector3::new(aft, -wide, -height), Vector3::new(fore, wide, 0.0)));
        Self { hull, ..self }
    }

    /// Points that bound the vehicle and its shadow, for a sun in `sun` (vehicle frame, toward it).
    pub(super) fn outline(&self, sun: &Vector3<f32>) -> Vec<Vector3<f32>> {
        let mut points = Vec::with_capacity(16);
        for plate in &self.plates {
            for (i, j) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                let reach = plate.half * plate.reach() * 1.42;
                points.push(plate.centre + Vector3::new(i * reach, j * reach, 0.0));
            }
        }
        if let Some((low, high)) = &self.hull {
            for (x, y) in [(low.x, low.y), (low.x, high.y), (high.x, low.y), (high.x, high.y)] {
                let top = Vector3::new(x, y, low.z);
                points.push(top);
                points.push(Vector3::new(x, y, 0.0));
                // Where the shadow of this corner falls: along the ray from the sun to the ground.
                points.push(top - sun * (low.z / sun.z));
            }
        }
        points
    }

    /// The nearest surface along a ray, in the vehicle frame.
    pub(super) fn hit(&self, placed: &Placed, direction: &Vector3<f32>) -> Option<Hit> {
        let origin = &placed.origin;
        let covered = placed.covered.iter().copied().chain(std::iter::repeat(0.0));
        let plates = self.plates.iter().zip(covered).filter_map(|(p, c)| p.hit(origin, direction, c));
        let nearest = plates.chain(self.hull_hit(origin, direction)).min_by(|a, b| a.0.total_cmp(&b.0));
        nearest.map(|(at, level)| Hit::Surface { level, at })
    }

    fn hull_hit(&self, origin: &Vector3<f32>, direction: &Vector3<f32>) -> Option<(f32, f32)> {
        let (low, high) = self.hull.as_ref()?;
        let (at, axis) = slab(low, high, origin, direction)?;
        if let Some(paint) = &self.paint {
            return Some((at, paint.level(&(origin + direction * at))));
        }
        if axis != 2 {
            return Some((at, SIDES));
        }
        let x = origin.x + at * direction.x;
        let glass = (self.windscreen.0..self.windscreen.1).contains(&x);
        Some((at, if glass { WINDSCREEN } else { self.level }))
    }

    /// Whether the body keeps the sun from a point of the ground, in the vehicle frame.
    pub(super) fn shades(&self, ground: &Vector3<f32>, sun: &Vector3<f32>) -> bool {
        self.hull.as_ref().is_some_and(|(low, high)| slab(low, high, ground, sun).is_some())
    }
}

/// Where a ray enters a box: distance and axis of the face.
fn slab(
    low: &Vector3<f32>,
    high: &Vector3<f32>,
    origin: &Vector3<f32>,
    direction: &Vector3<f32>,
) -> Option<(f32, usize)> {
    let (mut enter, mut leave, mut face) = (0.0_f32, f32::INFINITY, 2);
    for axis in 0..3 {
        let inverse = 1.0 / direction[axis];
        let (a, b) = ((low[axis] - origin[axis]) * inverse, (high[axis] - origin[axis]) * inverse);
        let (near, far) = (a.min(b), a.max(b));
        if near > enter {
            (enter, face) = (near, axis);
        }
        leave = leave.min(far);
    }
    (enter < leave).then_some((enter, face))
}

fn disc_level(marker: &MarkerConfig) -> f32 {
    if let Some(Brightness::Dark) = marker.brightness {
        return BLACK;
    }
    let Some(color) = &marker.color else { return WHITE };
    let part = |k: usize| color.get(k..k + 2).and_then(|x| u8::from_str_radix(x, 16).ok()).unwrap_or(0);
    // Luma of ITU-R BT.601.
    0.299 * f32::from(part(1)) + 0.587 * f32::from(part(3)) + 0.114 * f32::from(part(5))
}

impl Plate {
    fn new(marker: &MarkerConfig) -> Self {
        let centre = Vector3::from(marker.position_m).cast::<f32>();
        let (s, c) = (marker.yaw_deg.to_radians() as f32).sin_cos();
        let half = 0.5 * marker.size_m.or(marker.diameter_m).unwrap_or(0.0) as f32;
        let face = match (marker.kind, marker.family, marker.id) {
            (MarkerKind::Apriltag, Some(family), Some(id)) => Face::Tag(tag_pattern(
                TagLayout {
                    family,
                    border: marker.border,
                    mirrored: marker.mirrored,
                    inverted: marker.inverted,
                },
                id,
            )),
            _ => Face::Disc(disc_level(marker)),
        };
        Self { centre, top: (c, s), half, face }
    }

    /// How far the plate reaches, in half edges of the black square.
    fn reach(&self) -> f32 {
        match &self.face {
            Face::Tag(pattern) => pattern.side() as f32 / pattern.border as f32,
            Face::Disc(_) => 1.0,
        }
    }

    /// Distance and grey level where a ray meets the plate, or what covers this share of it.
    fn hit(&self, origin: &Vector3<f32>, direction: &Vector3<f32>, covered: f32) -> Option<(f32, f32)> {
        let at = (self.centre.z - origin.z) / direction.z;
        if !(at > 0.0) {
            return None;
        }
        let (dx, dy) =
            (origin.x + at * direction.x - self.centre.x, origin.y + at * direction.y - self.centre.y);
        let top = self.top.0 * dx + self.top.1 * dy;
        let right = self.top.0 * dy - self.top.1 * dx;
        let reach = self.half * self.reach();
        if covered > 0.0 && top.abs() < reach && right.abs() < reach && right > reach * (1.0 - 2.0 * covered)
        {
            return Some((at, COVER));
        }
        match &self.face {
            Face::Disc(level) => (dx * dx + dy * dy <= self.half * self.half).then_some((at, *level)),
            Face::Tag(pattern) => {
                let scale = 0.5 * pattern.border as f32 / self.half;
                let middle = 0.5 * pattern.side() as f32;
                let (x, y) = (right * scale + middle, middle - top * scale);
                let side = pattern.side() as f32;
                let inside = x >= 0.0 && y >= 0.0 && x < side && y < side;
                inside.then(|| (at, if pattern.white(x as usize, y as usize) { WHITE } else { BLACK }))
            }
        }
    }
}

/// A vehicle as it stands at one moment, seen from the camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    /// Takes a direction in the camera frame into the vehicle frame.
    pub(super) vehicle_from_camera: Matrix3<f32>,
    /// The camera in the vehicle frame.
    pub(super) origin: Vector3<f32>,
    /// Toward the sun, in the vehicle frame.
    pub(super) sun: Vector3<f32>,
    /// Shares of its markers that are covered.
    pub(super) covered: [f32; COVERABLE],
}
