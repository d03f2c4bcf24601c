//! What updates make of the covariance: directions that nothing shows, delayed copies, states that are held.

use super::*;

/// Turning helicopter, velocity and everything seen about the vertical changes no pixel, whatever was fused before:
/// the covariance is carried along so that no heading comes of it (`State::keep_heading_unobserved`).
#[test]
fn nothing_seen_shows_absolute_heading() {
    for seed in 0..STATES {
        let core = random_core(seed, Ground::Flat { down_m: 0.0 });
        let state = &core.state;
        let mut turn = vec![0.0; state.layout().len()];
        let layout = state.layout();
        let mut put = |place: Block<2>, north: f64, east: f64| {
            turn[place.range()].copy_from_slice(&[-east, north]);
        };
        put(own::POSITION.part(0), state.own.position.x, state.own.position.y);
        put(own::VELOCITY.part(0), state.own.velocity.x, state.own.velocity.y);
        for (i, target) in state.targets.iter().enumerate() {
            put(layout.target(i).place(), target.mean[0], target.mean[1]);
        }
        for (i, feature) in state.features.iter().enumerate() {
            put(layout.feature(i), feature.mean[0], feature.mean[1]);
        }
        turn[own::TURN.column(0)] = 1.0;
        (0..layout.targets).for_each(|i| turn[layout.target(i).heading().column(0)] = 1.0);
        let turn = nalgebra::DVector::from(turn);
        for target in 0..state.targets.len() {
            let seen = detection(&core, target, 0);
            let (h, _) = measured(&mut core.clone(), &|core| {
                core.fuse_marker(target, 0, &seen, false);
            });
            let pixels = (h * &turn).amax();
            assert!(pixels < 1e-8, "seed {seed}, target {target}: {pixels} px per radian");
        }
    }
}

/// Along the two directions in which nobody can tell who is wrong (all that is seen larger, all tags turned on their
/// vehicle) no pixel changes, of tags nor of ground features.
#[test]
fn nothing_seen_shows_scale_or_how_tags_are_turned() {
    for seed in 0..STATES {
        let mut core = random_core(seed, Ground::Flat { down_m: 0.0 });
        core.state.tags.iter_mut().for_each(|tag| tag.mean = [0.0; 4]);
        // A body that is rolled or pitched lies otherwise to the ground: by its angle the directions are then off.
        core.state.targets.iter_mut().for_each(|target| target.sway.mean = [0.0; 3]);
        let mut along = vec![0.0; core.state.layout().len()];
        for target in 0..core.state.targets.len() {
            let seen = detection(&core, target, 0);
            let pixels = |along: &[f64], fuse: &dyn Fn(&mut Core)| {
                let (h, _) = measured(&mut core.clone(), fuse);
                (h * nalgebra::DVector::from_column_slice(along)).amax()
            };
            let tag = |core: &mut Core| _ = core.fuse_marker(target, 0, &seen, false);
            let ground = |core: &mut Core| {
                FeaturePixel { slot: 3, px: Vector2::new(640.0, 512.0), sigma_px: 1.0, slack_m: 0.0 }
                    .fuse(core);
            };
            assert!(core.scale_direction(target, &mut along).is_some());
            assert!(
                pixels(&along, &tag) < 1e-6,
                "seed {seed}, scale of target {target}: {}",
                pixels(&along, &tag)
            );
            assert!(pixels(&along, &ground) < 1e-6, "seed {seed}: {} of the ground", pixels(&along, &ground));
            core.turn_direction(target, &mut along);
            assert!(
                pixels(&along, &tag) < 1e-6,
                "seed {seed}, turn of target {target}: {}",
                pixels(&along, &tag)
            );
        }
    }
}

/// A delayed copy is moved by an update as if it were part of the state: against the same update in dense matrices.
#[test]
fn delayed_copies_are_fused_like_states() {
    for seed in 0..STATES {
        let mut core = random_core(seed, Ground::Flat { down_m: 0.0 });
        let n = core.state.layout().len();
        let copied = core.state.copies[0].mean.len();
        let mut rng = ChaCha8Rng::seed_from_u64(2_000 + seed);
        let root = DMatrix::from_fn(n + copied, n + copied, |_, _| rng.random_range(-0.05..0.05));
        let p = &root * root.transpose();
        (0..n).for_each(|i| (0..n).for_each(|j| core.state.cov.set(i, j, p[(i, j)])));
        let copy = &mut core.state.copies[0];
        copy.in_use = true;
        for i in 0..copied {
            (0..n).for_each(|j| copy.cross.set(i, j, p[(n + i, j)]));
            (0..copied).for_each(|j| copy.cov.set(i, j, p[(n + i, n + j)]));
        }
        // Seen a pixel off where it is expected, so that the gate has no part in it.
        let (target, marker) = (1, 0);
        let mut seen = detection(&core, target, marker);
        let corners = core.models.targets[target].markers[marker].corners.expect("a tag");
        seen.corners_px = Some(corners.map(|corner| {
            let (world, _) = target_point(&core.state.targets[target].mean, &core.models, &corner);
            view(&core.state.own, &core.models, &world).expect("it lies below").px + Vector2::new(1.0, -0.5)
        }));
        let z = {
            let mut twin = core.clone();
            twin.fuse_marker(target, marker, &seen, false);
            twin.z.clone()
        };
        core.state.copies.truncate(1);
        let h = DMatrix::from_fn(z.m, n + copied, |i, j| if j < n { z.derivative(i, j) } else { 0.0 });
        let r = DMatrix::from_fn(z.m, z.m, |i, j| z.noise[i][j]);
        let s = &h * &p * h.transpose() + r;
        let gain = &p * h.transpose() * s.try_inverse().expect("positive definite");
        let step = &gain * nalgebra::DVector::from_column_slice(&z.residual[..z.m]);
        let left = &p - &gain * &h * &p;
        core.fuse_marker(target, marker, &seen, false);
        let copy = &core.state.copies[0];
        for i in 0..copied {
            assert!((copy.mean[i] - step[n + i]).abs() < 1e-6, "seed {seed}: mean {i}");
            for j in 0..copied {
                let (got, want) = (copy.cov.at(i, j), left[(n + i, n + j)]);
                assert!(
                    (got - want).abs() < 1e-6 * (1.0 + want.abs()),
                    "seed {seed}: {i}, {j}: {got} for {want}"
                );
            }
        }
    }
}

/// A measurement into a state some of whose parts are held, against Joseph's form in dense matrices with those rows of the
/// gain at zero. A delayed copy is part of that state.
#[test]
fn held_states_are_considered_and_not_moved() {
    let held = Held::NONE.and(own::TRIM).and(own::DRAG).and(own::TILT_ERROR).and(own::TURN);
    for seed in 0..STATES {
        let mut core = random_core(seed, Ground::Flat { down_m: 0.0 });
        let n = core.state.layout().len();
        let copied = core.state.copies[0].mean.len();
        let mut rng = ChaCha8Rng::seed_from_u64(3_000 + seed);
        let root = DMatrix::from_fn(n + copied, n + copied, |_, _| rng.random_range(-0.05..0.05));
        let p = &root * root.transpose();
        (0..n).for_each(|i| (0..n).for_each(|j| core.state.cov.set(i, j, p[(i, j)])));
        core.state.copies.truncate(1);
        let copy = &mut core.state.copies[0];
        copy.in_use = true;
        for i in 0..copied {
            (0..n).for_each(|j| copy.cross.set(i, j, p[(n + i, j)]));
            (0..copied).for_each(|j| copy.cov.set(i, j, p[(n + i, n + j)]));
        }
        // A reading off by less than a sigma, of the kind that touches most states; what it moves is small, so that the
        // shear that keeps heading unobserved has no part in it.
        core.state.tilt[0].felt = Felt::Force;
        let reading = TiltReading::<0> { down: Vector3::z() };
        core.linearise(&reading).expect("it can be predicted");
        core.z.residual = core.z.residual.map(|r| 1e-9 * r);
        let z = core.z.clone();
        let h = DMatrix::from_fn(z.m, n + copied, |i, j| if j < n { z.derivative(i, j) } else { 0.0 });
        let r = DMatrix::from_fn(z.m, z.m, |i, j| z.noise[i][j]);
        let s = &h * &p * h.transpose() + &r;
        let mut gain = &p * h.transpose() * s.try_inverse().expect("positive definite");
        held.columns().for_each(|i| gain.row_mut(i).fill(0.0));
        let kept = DMatrix::identity(n + copied, n + copied) - &gain * &h;
        let wanted = &kept * &p * kept.transpose() + &gain * r * gain.transpose();
        let before = core.state.clone();
        core.work.fuse(&mut core.state, &z, None, held);
        let moved = difference(&core.state, &before);
        // A turn is found from a product of rotations, which rounds; the covariance shows that heading is held.
        let exact = held.columns().filter(|i| !own::ATTITUDE.range().contains(i));
        exact.for_each(|i| assert!(moved[i] == 0.0, "seed {seed}: {i} was moved"));
        let copy = &core.state.copies[0];
        let got = |i: usize, j: usize| match (i.checked_sub(n), j.checked_sub(n)) {
            (None, None) => core.state.cov.at(i, j),
            (Some(i), None) => copy.cross.at(i, j),
            (None, Some(j)) => copy.cross.at(j, i),
            (Some(i), Some(j)) => copy.cov.at(i, j),
        };
        for (i, j) in (0..n + copied).flat_map(|i| (0..n + copied).map(move |j| (i, j))) {
            let (got, want) = (got(i, j), wanted[(i, j)]);
            assert!((got - want).abs() < 1e-8, "seed {seed}: {i}, {j}: {got} for {want}");
        }
    }
}
