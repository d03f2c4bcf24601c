//! A misfit as text for the operator: which source, by how much, the likely cause, what to do.

use windhover_base::msg::{FeltTilt, FusionSource, MarkerPair, Misfit, MisfitCause, MisfitWords};
use windhover_base::settings::{MarkerConfig, MarkerKind, Rig};

/// The texts for a misfit of this rig.
pub(super) fn words(misfit: &Misfit, rig: &Rig) -> MisfitWords {
    let (kind, figure) = (kind(misfit.cause), misfit.figure);
    let of_source = |figure: String, cause: String, advice: String| MisfitWords {
        source: misfit.source.name().to_owned(),
        kind,
        figure,
        cause,
        advice,
    };
    let it = spoken(misfit.source);
    match misfit.cause {
        MisfitCause::TiltKind(felt) => tilt_kind(misfit, felt, rig),
        MisfitCause::Noise => of_source(
            format!("{figure:.1} times"),
            format!("{it} scatters more than configured: mean square of its innovations over the expected"),
            format!("look for what disturbs it, or raise {}", noise_keys(misfit.source)),
        ),
        MisfitCause::Bias => of_source(
            format!("{figure:.1} sigma"),
            format!("{it} has a constant error"),
            format!("check {}", bias_keys(misfit.source)),
        ),
        MisfitCause::Outside => of_source(
            format!("{:.0} %", 100.0 * figure),
            format!("too much of {it} lies outside the gate"),
            format!("check {} and {}", bias_keys(misfit.source), noise_keys(misfit.source)),
        ),
        MisfitCause::Late => late(misfit),
        MisfitCause::Filtered => of_source(
            format!("{figure:.2} s"),
            format!("the receiver smooths its velocity over {figure:.2} s, so that it is older than its position"),
            "switch off the receiver's smoothing (its dynamic model or low-speed filter), if it can be; the estimate allows for it"
                .into(),
        ),
        MisfitCause::MarkerSize(pair) => marker_size(figure, pair, rig),
        MisfitCause::MarkerPlace(pair) => of_marker(
            pair,
            rig,
            kind,
            format!("{figure:.3} m"),
            &format!("lies {:.1} cm from where it is configured", 100.0 * figure),
            "measure target.marker.position_m of both",
        ),
        MisfitCause::MarkerTurn(pair) => of_marker(
            pair,
            rig,
            kind,
            format!("{:.1} deg", figure.to_degrees()),
            &format!("is turned by {:.1} deg from how it is configured", figure.to_degrees()),
            "measure target.marker.yaw_deg of both",
        ),
        MisfitCause::Height => MisfitWords {
            source: "ground".into(),
            kind,
            figure: format!("{figure:.1} m"),
            cause: format!(
                "the helicopter is {:.1} m {} over the ground than receiver and [ground] give, measured by the \
                 markers' size",
                figure.abs(),
                if figure < 0.0 { "lower" } else { "higher" }
            ),
            advice:
                "check ground.elevation_msl_m, or start the program on the ground for source = \"takeoff\""
                    .into(),
        },
        MisfitCause::MovingGround => of_source(
            format!("{:.0} %", 100.0 * figure),
            "features treated as ground move: people, other vehicles, shadows, or a lens that is not as configured"
                .into(),
            "nothing, if it is temporary; else check camera.intrinsics and camera.readout_ms, or set \
             detector.ground_features = 0"
                .into(),
        ),
        MisfitCause::Wanders => of_source(
            format!("{figure:.1} times"),
            "the receiver's slow error varies more than configured, compared with vehicles and ground in the pictures".into(),
            "raise gps.bias_sigma_m; until then the filter assumes the larger error".into(),
        ),
        MisfitCause::Lens => MisfitWords {
            source: "camera".into(),
            kind,
            figure: format!("{figure:+.3}"),
            cause: "the lens's distortion differs from the configured one by this value of k1".into(),
            advice: "calibrate the camera (windhover calibrate), and check camera.intrinsics and the picture's size".into(),
        },
        MisfitCause::Readout => MisfitWords {
            source: "camera".into(),
            kind,
            figure: format!("{:.1} ms", 1e3 * figure),
            cause: format!("its rows are exposed one after the other, in {:.1} ms (a rolling shutter)", 1e3 * figure),
            advice: format!("set camera.readout_ms = {:.1}, or calibrate it", 1e3 * figure),
        },
        MisfitCause::AntennaPlace => of_source(
            format!("{figure:.2} m"),
            "the receiver's antenna is not at gps.antenna_position_m, as its motion in turns shows".into(),
            "measure the antenna's place from the body frame's origin again".into(),
        ),
        MisfitCause::TargetSways { target } => MisfitWords {
            source: target_name(rig, target),
            kind,
            figure: format!("{:.1} cm", 100.0 * figure),
            cause: "its body rolls, pitches or heaves on its springs".into(),
            advice: "nothing: the estimate allows for it, with a larger sigma of speed; markers mounted lower move less"
                .into(),
        },
        MisfitCause::TargetSlides { target } => MisfitWords {
            source: target_name(rig, target),
            kind,
            figure: format!("{figure:.0} times"),
            cause: "it moves across its heading".into(),
            advice: "nothing if it slides: the estimate allows for it; else check yaw_deg of its markers".into(),
        },
        MisfitCause::TargetTurns { target } => MisfitWords {
            source: target_name(rig, target),
            kind,
            figure: format!("{figure:.1} times"),
            cause: "it turns faster than its model can".into(),
            advice: "if it turns on the spot, set model = \"unicycle\"; else check wheelbase_m".into(),
        },
    }
}

/// A fixed name for each kind of misfit.
const fn kind(cause: MisfitCause) -> &'static str {
    match cause {
        MisfitCause::TiltKind(_) => "tilt_kind",
        MisfitCause::Noise => "noise",
        MisfitCause::Bias => "bias",
        MisfitCause::Outside => "outside",
        MisfitCause::MarkerSize(_) => "marker_size",
        MisfitCause::MarkerPlace(_) => "marker_place",
        MisfitCause::MarkerTurn(_) => "marker_turn",
        MisfitCause::Height => "height",
        MisfitCause::MovingGround => "moving_ground",
        MisfitCause::TargetTurns { .. } => "target_turns",
        MisfitCause::TargetSways { .. } => "target_sways",
        MisfitCause::AntennaPlace => "antenna_place",
        MisfitCause::Readout => "readout",
        MisfitCause::Lens => "lens",
        MisfitCause::Wanders => "wanders",
        MisfitCause::TargetSlides { .. } => "target_slides",
        MisfitCause::Late => "late",
        MisfitCause::Filtered => "filtered",
    }
}

/// What a tilt sensor measures, as part of a sentence.
pub(super) fn felt_words(felt: FeltTilt) -> String {
    match felt {
        FeltTilt::Attitude => "measures attitude, as an AHRS does".into(),
        FeltTilt::Force => "measures specific force, as an accelerometer does".into(),
        FeltTilt::Share(k) => format!("reads {:.0} % of the tilt", 100.0 * k),
    }
}

fn tilt_kind(misfit: &Misfit, felt: FeltTilt, rig: &Rig) -> MisfitWords {
    let second = misfit.source == FusionSource::AttitudeTilt;
    let section = if second { "attitude" } else { "compass" };
    let configured = match &rig.attitude {
        Some(attitude) if second => attitude.tilt,
        _ => rig.compass.tilt,
    };
    let right = if felt == FeltTilt::Attitude { "inertial" } else { "gravity" };
    MisfitWords {
        source: format!("{section}.tilt"),
        kind: kind(misfit.cause),
        figure: format!("slope {:.2}", misfit.figure),
        cause: format!("its tilt sensor {}, and is configured as {}", felt_words(felt), configured.name()),
        advice: format!("set {section}.tilt = \"{right}\""),
    }
}

fn late(misfit: &Misfit) -> MisfitWords {
    let by_ms = 1e3 * misfit.figure;
    let (key, change) = match misfit.source {
        FusionSource::Marker | FusionSource::Feature => ("camera.exposure_offset_ms", -by_ms),
        FusionSource::GpsPosition | FusionSource::GpsVelocity => ("gps.latency_ms", by_ms),
        FusionSource::CompassHeading | FusionSource::CompassTilt => ("compass.latency_ms", by_ms),
        FusionSource::AttitudeHeading | FusionSource::AttitudeTilt => ("attitude.latency_ms", by_ms),
        FusionSource::ImuRate | FusionSource::ImuForce => ("imu.latency_ms", by_ms),
    };
    MisfitWords {
        source: misfit.source.name().to_owned(),
        kind: kind(misfit.cause),
        figure: format!("{by_ms:.0} ms"),
        cause: format!(
            "{} was measured {:.0} ms {} than its time stamps",
            spoken(misfit.source),
            by_ms.abs(),
            if by_ms < 0.0 { "later" } else { "earlier" }
        ),
        advice: format!("change {key} by {change:+.0}"),
    }
}

fn marker_size(ratio: f64, pair: MarkerPair, rig: &Rig) -> MisfitWords {
    let percent = 100.0 * (ratio - 1.0);
    let configured = marker(rig, pair.target, pair.marker).and_then(|m| m.size_m.or(m.diameter_m));
    let measured =
        configured.map_or(String::new(), |m| format!(", about {:.3} m by the pictures", m * ratio));
    of_marker(
        pair,
        rig,
        "marker_size",
        format!("{percent:+.1} %"),
        &format!(
            "is {:.1} % {} than configured",
            percent.abs(),
            if percent < 0.0 { "smaller" } else { "larger" }
        ),
        &format!("measure the edge of its black square{measured}"),
    )
}

fn of_marker(
    pair: MarkerPair,
    rig: &Rig,
    kind: &'static str,
    figure: String,
    what: &str,
    advice: &str,
) -> MisfitWords {
    let name = |index| marker_name(rig, pair.target, index);
    MisfitWords {
        source: format!("{} {}", target_name(rig, pair.target), name(pair.marker)),
        kind,
        figure,
        cause: format!("{} {what}, measured against {}", name(pair.marker), name(pair.against)),
        advice: advice.to_owned(),
    }
}

fn marker(rig: &Rig, target: usize, marker: usize) -> Option<&MarkerConfig> {
    rig.target.get(target)?.marker.get(marker)
}

fn target_name(rig: &Rig, target: usize) -> String {
    rig.target.get(target).map_or_else(|| format!("target {target}"), |target| target.name.clone())
}

/// `tag 1`, by its identity, or `disc 0`, by its place in the configuration.
pub(super) fn marker_name(rig: &Rig, target: usize, index: usize) -> String {
    match marker(rig, target, index) {
        Some(MarkerConfig { kind: MarkerKind::Apriltag, id: Some(id), .. }) => format!("tag {id}"),
        _ => format!("disc {index}"),
    }
}

/// Name of a source at the beginning of a sentence.
const fn spoken(source: FusionSource) -> &'static str {
    match source {
        FusionSource::GpsPosition => "the receiver's position",
        FusionSource::GpsVelocity => "the receiver's velocity",
        FusionSource::CompassHeading => "the compass's heading",
        FusionSource::CompassTilt => "the compass's tilt",
        FusionSource::AttitudeHeading => "the second attitude's heading",
        FusionSource::AttitudeTilt => "the second attitude's tilt",
        FusionSource::ImuRate => "the gyros' rate",
        FusionSource::ImuForce => "the accelerometers' force",
        FusionSource::Marker => "the markers' place in the pictures",
        FusionSource::Feature => "the ground's motion in the pictures",
    }
}

/// The keys that configure the scatter of a source.
const fn noise_keys(source: FusionSource) -> &'static str {
    match source {
        FusionSource::GpsPosition => "gps.bias_sigma_m and gps.noise_m",
        FusionSource::GpsVelocity => "gps.velocity_noise_mps",
        FusionSource::CompassHeading => "compass.heading_bias_sigma_deg and compass.heading_noise_deg",
        FusionSource::CompassTilt => "compass.tilt_noise_deg",
        FusionSource::AttitudeHeading => "attitude.heading_bias_sigma_deg and attitude.heading_noise_deg",
        FusionSource::AttitudeTilt => "attitude.tilt_noise_deg",
        FusionSource::ImuRate => "imu.rate_noise_dps",
        FusionSource::ImuForce => "imu.force_noise_mps2",
        FusionSource::Marker => "estimator.marker_noise_px",
        FusionSource::Feature => "estimator.feature_sigma_factor",
    }
}

/// The keys that shift a source.
const fn bias_keys(source: FusionSource) -> &'static str {
    match source {
        FusionSource::GpsPosition => "gps.antenna_position_m and ground",
        FusionSource::GpsVelocity => "gps.latency_ms and gps.antenna_position_m",
        FusionSource::CompassHeading => {
            "compass.declination_deg, compass.yaw_offset_deg and iron near the compass"
        }
        FusionSource::CompassTilt => "compass.tilt, compass.pitch_offset_deg and compass.roll_offset_deg",
        FusionSource::AttitudeHeading => {
            "how the second source of attitude is mounted, and that its heading is true"
        }
        FusionSource::AttitudeTilt => "attitude.tilt and how the second source of attitude is mounted",
        FusionSource::ImuRate | FusionSource::ImuForce => "imu.yaw_deg, imu.pitch_deg and imu.roll_deg",
        FusionSource::Marker => "sizes and places of the markers, camera.intrinsics and camera.mount",
        FusionSource::Feature => "camera.intrinsics, camera.mount and ground",
    }
}
