//! Rendered frames show what the truth says, where it says, and are the same for any thread count.

use std::sync::Arc;

use super::*;
use crate::{MarkerTruth, Scenario};
use windhover_base::msg::TagFamily;
use windhover_detect::{Detector, Limits, TagDetection};

fn frame(scenario: Scenario, seed: u64, t_s: f64) -> (Arc<World>, GrayImage) {
    let world = Arc::new(World::new(scenario, seed));
    let mut image = GrayImage::default();
    Renderer::new(Arc::clone(&world)).render(world.time(t_s), 0, &mut image);
    (world, image)
}

/// Every visible tag with what was found of it.
fn found(world: &World, image: &GrayImage, t_s: f64) -> Vec<(MarkerTruth, Option<TagDetection>)> {
    let (t, config) = (world.time(t_s), &world.scenario().rig);
    let mut families: Vec<TagFamily> =
        config.target.iter().flat_map(|t| &t.marker).filter_map(|m| m.family).collect();
    families.sort_unstable();
    families.dedup();
    let mut detector = Detector::new(&families, Limits { min_px: 10.0, max_hamming: 1 });
    let detections = detector.detect(image.view());
    let mut pairs = Vec::new();
    for (target, settings) in config.target.iter().enumerate() {
        for (marker, tag) in settings.marker.iter().enumerate() {
            let truth = world.marker(target, marker, t).expect("below the camera");
            let (Some(family), Some(id), true) = (tag.family, tag.id, truth.visible) else { continue };
            let found = detections.iter().find(|d| (d.family, d.id) == (family, id));
            pairs.push((truth, found.copied()));
        }
    }
    pairs
}

/// Which true corner a detected one is nearest to, for each of the four.
fn order(detection: &TagDetection, truth: &MarkerTruth) -> [usize; 4] {
    detection.corners_px.map(|at| {
        (0..4)
            .min_by(|a, b| (truth.corners_px[*a] - at).norm().total_cmp(&(truth.corners_px[*b] - at).norm()))
            .expect("there are four")
    })
}

#[test]
fn tags_are_found_where_the_truth_says() {
    let (mut all, mut off) = (0, Vec::new());
    for (name, scale, t_s) in [
        ("hover10", 0.5, 3.0),
        ("crooked-mount", 0.75, 5.0),
        ("two-vehicles", 1.0, 8.0),
        ("static-survey", 0.5, 2.0),
        ("elevation-compass", 0.75, 12.0),
    ] {
        let scenario = Scenario::named(name).expect("known").with_resolution(scale);
        let (world, image) = frame(scenario, 9, t_s);
        for (truth, detection) in found(&world, &image, t_s) {
            all += 1;
            let Some(detection) = detection else { continue };
            off.push((detection.center_px - truth.center_px).norm());
            // Neither mirrored nor turned.
            assert_eq!(order(&detection, &truth), [0, 1, 2, 3], "{name}");
        }
    }
    assert!(all >= 8 && off.len() == all, "{} of {all} tags found", off.len());
    // The detector's own errors are its tests' matter; a wrong lens, mount or pixel convention
    // would move them all.
    off.sort_by(f64::total_cmp);
    assert!(off[off.len() / 2] < 0.2 && off[off.len() - 1] < 1.5, "centres off by {off:?} px");
}

#[test]
fn every_family_is_drawn_as_it_is_read() {
    for family in TagFamily::ALL {
        let mut scenario = Scenario::named("hover10").expect("known").with_resolution(0.75);
        for (k, marker) in scenario.rig.target[0].marker.iter_mut().enumerate() {
            (marker.family, marker.id, marker.yaw_deg) = (Some(family), Some(k as u32 + 3), 90.0 * k as f64);
        }
        let (world, image) = frame(scenario, 2, 1.0);
        let pairs = found(&world, &image, 1.0);
        assert_eq!(pairs.len(), 2);
        for (truth, detection) in pairs {
            let detection = detection.unwrap_or_else(|| panic!("{} is not found", family.name()));
            let off = (detection.center_px - truth.center_px).norm();
            assert!(off < 1.5, "{}: {off} px off", family.name());
            assert_eq!(order(&detection, &truth), [0, 1, 2, 3], "{}: turned or mirrored", family.name());
        }
    }
}

#[test]
fn any_number_of_threads_draws_the_same_frame() {
    let scenario = Scenario::named("follow").expect("known").with_resolution(0.25);
    let (world, alone) = frame(scenario, 4, 6.0);
    let mut together = GrayImage::default();
    Renderer::new(Arc::clone(&world)).with_threads(3).render(world.time(6.0), 0, &mut together);
    assert!(alone == together);
    let mut next = GrayImage::default();
    Renderer::new(Arc::clone(&world)).render(world.time(6.0), 1, &mut next);
    assert!(alone != next, "two frames have the same noise");
}

fn contrast(image: &GrayImage) -> f64 {
    let steps = image.data.windows(2).map(|pair| f64::from(pair[0].abs_diff(pair[1])));
    steps.sum::<f64>() / image.data.len() as f64
}

fn brightness(image: &GrayImage) -> f64 {
    image.data.iter().map(|x| f64::from(*x)).sum::<f64>() / image.data.len() as f64
}

#[test]
fn exposure_smears_and_light_changes() {
    let base = || {
        let mut scenario = Scenario::named("fast-turns").expect("known").with_resolution(0.5);
        (scenario.scene.noise_levels, scenario.scene.vignetting) = (0.0, 0.0);
        scenario
    };
    let (_, sharp) = frame(base(), 5, 7.0);
    let mut long = base();
    long.scene.exposure_ms = 40.0;
    let (_, smeared) = frame(long, 5, 7.0);
    assert!(contrast(&smeared) < 0.8 * contrast(&sharp), "{} {}", contrast(&smeared), contrast(&sharp));
    assert!((brightness(&smeared) / brightness(&sharp) - 1.0).abs() < 0.02);

    let mut brighter = base();
    brighter.scene.light_change = Some((6.0, 1.4));
    let (_, after) = frame(brighter, 5, 7.0);
    assert!((1.3..1.41).contains(&(brightness(&after) / brightness(&sharp))));

    let mut bands = base();
    bands.scene.shadow_bands_m = Some(3.0);
    let (_, banded) = frame(bands, 5, 7.0);
    assert!((0.6..0.82).contains(&(brightness(&banded) / brightness(&sharp))), "half lies in shadow");
}
