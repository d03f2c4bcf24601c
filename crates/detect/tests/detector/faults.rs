//! What pictures do to tags: haze, over-exposure, the frame's rim, other things that touch, other prints. Each drawn as
//! it was once missed or found wrong.

use nalgebra::{Matrix3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use windhover_detect::{
    Detector, GrayImage, Limits, TagDetection, TagFamily, TagLayout, TagPattern, tag_pattern,
};

/// A tag on plain ground, and the light on it.
#[derive(Clone, Copy)]
struct Scene {
    size: (usize, usize),
    layout: TagLayout,
    id: u32,
    /// Middle, edge, turn about the optical axis and tilt about the image's u axis: pixels and radians.
    middle: Vector2<f64>,
    edge: f64,
    turn: f64,
    tilt: f64,
    /// Grey levels; above 255 over-exposed.
    white: f64,
    black: f64,
    ground: f64,
    blur: f64,
    noise: f64,
    /// Whether dark squares touch the border's corners, as on Kalibr's sheets.
    squares: bool,
    /// Where a shadow begins: its direction and how far from the tag's middle, and the share of the light left in it.
    shade: Option<(Vector2<f64>, f64, f64)>,
    /// A tag in the free middle of a nested one, over its four cells with all its print.
    inner: Option<(TagFamily, u32)>,
    /// How far motion smears the image along its rows, pixels.
    motion: f64,
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            size: (200, 160),
            layout: TagFamily::Tag36h11.into(),
            id: 7,
            middle: Vector2::new(100.3, 80.4),
            edge: 60.0,
            turn: 0.2,
            tilt: 0.0,
            white: 220.0,
            black: 25.0,
            ground: 110.0,
            blur: 0.7,
            noise: 1.5,
            squares: false,
            shade: None,
            motion: 0.0,
            inner: None,
        }
    }
}

impl Scene {
    /// Takes tag coordinates (border square from −1 to 1) to pixels.
    fn view(&self) -> Matrix3<f64> {
        let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::x_axis(), self.tilt)
            * nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), self.turn);
        let (focal, depth) = (1000.0, 2.0 * 1000.0 / self.edge);
        let camera = Matrix3::new(focal, 0.0, self.middle.x, 0.0, focal, self.middle.y, 0.0, 0.0, 1.0);
        let r = rotation.matrix();
        camera
            * Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), Vector3::new(0.0, 0.0, depth)])
    }

    fn corners(&self) -> [Vector2<f64>; 4] {
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| {
            let p = self.view() * Vector3::new(x, y, 1.0);
            Vector2::new(p.x / p.z, p.y / p.z)
        })
    }

    fn light(&self, pattern: &TagPattern, inner: Option<&TagPattern>, x: f64, y: f64) -> f64 {
        let cell = 2.0 / pattern.border as f64;
        let half = pattern.side() as f64 / 2.0;
        let far = x.abs().max(y.abs());
        let in_square = self.squares && x.abs().min(y.abs()) > 1.0 && far < 1.0 + 2.4 * cell;
        let (cx, cy) = (x / cell + half, y / cell + half);
        let on_print = cx >= 0.0 && cy >= 0.0 && cx < 2.0 * half && cy < 2.0 * half;
        if let Some(inner) = inner
            && (cx - half).abs().max((cy - half).abs()) < 1.0
        {
            let cell = |c: f64| ((c - half + 1.0) * 0.5 * inner.side() as f64) as usize;
            return if inner.white(cell(cx), cell(cy)) { self.white } else { self.black };
        }
        match on_print {
            _ if in_square => self.black,
            true if pattern.white(cx as usize, cy as usize) => self.white,
            true => self.black,
            false if self.squares && far < 1.0 + 4.0 * cell => self.white,
            false => self.ground,
        }
    }

    fn draw(&self, seed: u64) -> GrayImage {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pattern = tag_pattern(self.layout, self.id);
        let inner = self.inner.map(|(family, id)| tag_pattern(family, id));
        let back = self.view().try_inverse().expect("a view has an inverse");
        let mut kernel = Vec::new();
        for k in 0..16 {
            let normal: [f64; 2] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
            let square = [f64::from(k % 4) / 4.0 - 0.375, f64::from(k / 4) / 4.0 - 0.375];
            let along = ((f64::from(k) + 0.5) / 16.0 - 0.5) * self.motion;
            let at =
                Vector2::new(self.blur * normal[0] + square[0] + along, self.blur * normal[1] + square[1]);
            kernel.extend([at, -at]);
        }
        let (width, height) = self.size;
        let mut image = GrayImage::new(width, height);
        for (i, pixel) in image.data.iter_mut().enumerate() {
            let at = Vector2::new((i % width) as f64, (i / width) as f64);
            let light: f64 = kernel
                .iter()
                .map(|k| {
                    let p = back * (at + k).push(1.0);
                    let shaded = |(towards, off, _): &(Vector2<f64>, f64, f64)| {
                        towards.dot(&(at + k - self.middle)) > *off
                    };
                    let share = self.shade.filter(shaded).map_or(1.0, |s| s.2);
                    share * self.light(&pattern, inner.as_ref(), p.x / p.z, p.y / p.z)
                })
                .sum();
            let grain: f64 = StandardNormal.sample(&mut rng);
            *pixel = (light / kernel.len() as f64 + self.noise * grain + 0.5).clamp(0.0, 255.0) as u8;
        }
        image
    }

    fn detect(&self, as_layout: TagLayout, min_px: f64) -> Vec<TagDetection> {
        let mut detector = Detector::new(&[as_layout], Limits { min_px, max_hamming: 2 });
        detector.detect(self.draw(1).view()).to_vec()
    }

    /// Asserts that the tag alone is found, with corners within `worst` px, from each of these smallest sizes on.
    fn assert_found(&self, sizes: &[f64], worst: f64, what: &str) {
        for &min_px in sizes {
            let found = self.detect(self.layout, min_px);
            assert_eq!(found.iter().map(|t| t.id).collect::<Vec<_>>(), [self.id], "{what}, from {min_px} px");
            let error = farthest(&found[0], &self.corners());
            assert!(error < worst, "{what}, from {min_px} px: a corner is {error} px off");
        }
    }
}

fn farthest(found: &TagDetection, corners: &[Vector2<f64>; 4]) -> f64 {
    found.corners_px.iter().zip(corners).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

const SIZES: [f64; 4] = [8.0, 12.0, 16.0, 24.0];

#[test]
fn weak_contrast_is_found_where_it_stands_out_of_the_noise() {
    for (white, black, ground) in [(250.0, 190.0, 222.0), (120.0, 95.0, 106.0), (60.0, 44.0, 52.0)] {
        let scene = Scene { white, black, ground, noise: 0.8, ..Scene::default() };
        scene.assert_found(&SIZES, 0.35, &format!("{white} on {black}"));
    }
}

#[test]
fn a_dim_tag_with_a_light_border_is_found() {
    for white in [30.0, 40.0, 60.0] {
        let layout = TagFamily::Tag41h12.into();
        let scene = Scene { layout, white, black: 3.0, ground: 2.0, noise: 0.8, ..Scene::default() };
        scene.assert_found(&SIZES, 0.35, &format!("white {white}"));
    }
}

#[test]
fn over_exposed_tags_are_found_and_their_corners_are_where_the_print_has_them() {
    for (edge, white) in [(43.0, 600.0), (60.0, 900.0), (94.0, 1300.0)] {
        let scene = Scene { edge, white, black: 20.0, ground: 90.0, blur: 1.0, ..Scene::default() };
        scene.assert_found(&[12.0, 16.0, 24.0], 0.4, &format!("{edge} px, white {white}"));
    }
}

#[test]
fn a_border_of_two_cells_is_a_layout_and_is_not_taken_for_one_of_one() {
    let wide = TagLayout { border: 2, ..TagFamily::Tag36h11.into() };
    for (edge, turn) in [(40.0, 0.3), (70.0, 1.1), (110.0, -0.4)] {
        let scene = Scene { layout: wide, edge, turn, ..Scene::default() };
        scene.assert_found(&SIZES, 0.2, &format!("{edge} px"));
        for min_px in SIZES {
            let found = scene.detect(TagFamily::Tag36h11.into(), min_px);
            assert_eq!(found, [], "{edge} px taken for a border of one cell, from {min_px} px");
        }
    }
}

#[test]
fn mirrored_and_inverted_tags_are_layouts_and_found_as_no_other() {
    for family in [TagFamily::Tag36h11, TagFamily::Tag41h12, TagFamily::Aruco5x5N50, TagFamily::Tag48h12] {
        let ways = [(false, false), (true, false), (false, true), (true, true)];
        for (mirrored, inverted) in ways {
            let layout = TagLayout { mirrored, inverted, ..family.into() };
            let scene = Scene { layout, edge: 60.0, turn: 0.6, tilt: 0.3, ..Scene::default() };
            let name = format!("{} mirrored {mirrored} inverted {inverted}", family.name());
            scene.assert_found(&SIZES, 0.25, &name);
            for (mirrored, inverted) in ways.into_iter().filter(|way| *way != (mirrored, inverted)) {
                let other = TagLayout { mirrored, inverted, ..layout };
                assert_eq!(scene.detect(other, 12.0), [], "{name}, taken for {other:?}");
            }
        }
    }
}

#[test]
fn a_tag_inside_a_tag_is_found_beside_it() {
    for (family, id) in [(TagFamily::Tag48h12, 11), (TagFamily::Tag36h11, 11)] {
        let layout = TagFamily::Tag48h12.into();
        let (size, middle) = ((420, 400), Vector2::new(210.3, 199.6));
        let scene = Scene {
            size,
            middle,
            layout,
            edge: 216.0,
            turn: 0.4,
            tilt: 0.3,
            inner: Some((family, id)),
            ..Scene::default()
        };
        let image = scene.draw(1);
        for min_px in SIZES {
            let families = [TagFamily::Tag48h12, TagFamily::Tag36h11];
            let mut detector = Detector::new(&families, Limits { min_px, max_hamming: 2 });
            let mut ids: Vec<(TagFamily, u32)> =
                detector.detect(image.view()).iter().map(|t| (t.family, t.id)).collect();
            ids.sort_unstable();
            let mut both = [(TagFamily::Tag48h12, 7), (family, id)];
            both.sort_unstable();
            assert_eq!(ids, both, "from {min_px} px");
        }
    }
}

#[test]
fn squares_that_touch_a_tags_corners_do_not_hide_it() {
    for (edge, turn) in [(36.0, 0.1), (52.0, 0.8), (76.0, 0.0), (76.0, 0.4)] {
        let scene = Scene { edge, turn, squares: true, ..Scene::default() };
        scene.assert_found(&SIZES, 0.2, &format!("{edge} px, turned by {turn}"));
    }
}

#[test]
fn tags_are_found_at_the_frames_rim() {
    for (left, edge) in [2.0, 4.0, 7.0].into_iter().flat_map(|left| [(left, 48.0), (left, 120.0)]) {
        let (width, height) = (200.0, 160.0);
        let half = edge / 2.0;
        for (u, v) in [
            (left + half, 80.0),
            (width - 1.0 - left - half, 80.0),
            (100.0, left + half),
            (100.0, height - 1.0 - left - half),
        ] {
            let scene = Scene { middle: Vector2::new(u, v), edge, turn: 0.0, ..Scene::default() };
            scene.assert_found(&[12.0, 16.0, 24.0], 0.3, &format!("{left} px left, {edge} px at {u}, {v}"));
        }
    }
}

#[test]
fn a_tag_tilted_by_80_degrees_is_read() {
    for turn in [0.0, 0.05] {
        let scene = Scene { edge: 100.0, tilt: 80f64.to_radians(), turn, blur: 0.5, ..Scene::default() };
        scene.assert_found(&[8.0, 12.0, 16.0], 1.5, &format!("turned by {turn}"));
    }
}

#[test]
fn tags_of_every_family_are_found() {
    for family in TagFamily::ALL {
        let cells = tag_pattern(family, 7).border as f64;
        for (edge, turn) in [(4.5 * cells, 0.3), (10.0 * cells, 1.9)] {
            let scene = Scene { layout: family.into(), edge, turn, ..Scene::default() };
            scene.assert_found(&[12.0], 0.35, &format!("{}, {edge} px", family.name()));
        }
    }
}

/// Whatever is found from 12 px on is found from 16 and 24 px on where it is larger: tags half in shadow, smeared, seen
/// aslant, beside squares that touch them.
#[test]
fn a_size_asked_for_loses_no_larger_tag() {
    let mut rng = ChaCha8Rng::seed_from_u64(21);
    let mut compared = 0;
    for k in 0..48 {
        let direction: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let shade = (Vector2::new(direction.cos(), direction.sin()), rng.random_range(-12.0..12.0), 0.35);
        let scene = Scene {
            size: (300, 240),
            middle: Vector2::new(rng.random_range(110.0..190.0), rng.random_range(90.0..150.0)),
            edge: rng.random_range(30.0..80.0),
            turn: rng.random_range(0.0..std::f64::consts::TAU),
            tilt: if k % 4 == 3 { rng.random_range(0.9..1.25) } else { rng.random_range(0.0..0.6) },
            white: rng.random_range(120.0..230.0),
            ground: rng.random_range(35.0..90.0),
            blur: rng.random_range(0.6..1.2),
            noise: rng.random_range(1.5..6.0),
            motion: if k % 4 == 1 { rng.random_range(2.0..5.0) } else { 0.0 },
            shade: (k % 4 == 0).then_some(shade),
            squares: k % 4 == 2,
            ..Scene::default()
        };
        let image = scene.draw(k);
        let found = |min_px: f64| -> Option<TagDetection> {
            let mut detector = Detector::new(&[scene.layout], Limits { min_px, max_hamming: 2 });
            detector.detect(image.view()).first().copied()
        };
        let Some(tag) = found(12.0) else { continue };
        for min_px in [16.0, 24.0].into_iter().filter(|px| 1.1 * px < tag.size_px) {
            compared += 1;
            assert!(found(min_px).is_some(), "{k}, seed 21: {:.1} px, not from {min_px} px on", tag.size_px);
        }
    }
    assert!(compared > 70, "only {compared} comparisons, seed 21");
}

#[test]
fn textured_ground_of_any_contrast_holds_no_tags() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for (coarse, span) in [(2, 20), (3, 60), (5, 30), (9, 120)] {
        let blotches: Vec<u8> = (0..4096).map(|_| 90 + rng.random_range(0..span)).collect();
        let at = |u: usize, v: usize| {
            blotches[(u / coarse * 57 + v / coarse * 31 + u / coarse * (v / coarse)) % 4096]
        };
        let pixels = (0..320 * 240).map(|i| at(i % 320, i / 320)).collect();
        let image = GrayImage::from_vec(320, 240, pixels).expect("size");
        for min_px in SIZES {
            let families: Vec<TagFamily> =
                TagFamily::ALL.into_iter().filter(|&f| f != TagFamily::Tag16h5).collect();
            let mut detector = Detector::new(&families, Limits { min_px, max_hamming: 3 });
            assert_eq!(
                detector.detect(image.view()),
                [],
                "blotches of {coarse} px, from {min_px} px, seed 9"
            );
        }
    }
}
