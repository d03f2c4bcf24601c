//! Topic names. Topics of sources are in the table of sources ([`windhover_base::msg::Source`]).

/// Losses, and devices that appeared or disappeared.
pub const SOURCE_EVENT: &str = "/source/event";
/// The state from which a restarted daemon continued.
pub const WARM_START: &str = "/warm_start";
/// Position fixes for maps.
pub const GPS_FIX: &str = "/gps/fix";
/// GPS epochs with all fields.
pub const GPS_EPOCH: &str = "/gps/epoch";
/// Compass samples.
pub const COMPASS_ATTITUDE: &str = "/compass/attitude";
/// Transforms.
pub const TF: &str = "/tf";
/// Intrinsics.
pub const CAMERA_CALIBRATION: &str = "/camera/calibration";
/// The camera's picture as a film, where it is recorded.
pub const CAMERA_VIDEO: &str = "/camera/video";
/// Overlays for viewers.
pub const CAMERA_ANNOTATIONS: &str = "/camera/annotations";
/// Markers and features with all fields.
pub const CAMERA_DETECTIONS: &str = "/camera/detections";
/// Origin of the NED frame.
pub const DATUM: &str = "/datum";
/// The helicopter's own state.
pub const OWNSHIP: &str = "/ownship/state";
/// The disposition of each measurement.
pub const FUSION: &str = "/fusion";
/// Operator's notices.
pub const LOG: &str = "/log";
/// The helicopter's refined state, from the whole flight.
pub const OWNSHIP_REFINED: &str = "/ownship/refined";
/// The constants that a refinement found.
pub const REFINED: &str = "/refined";
/// Health, once a second.
pub const HEALTH: &str = "/health";

/// `/target/NAME/location`
pub fn target_location(name: &str) -> String {
    format!("/target/{name}/location")
}

/// `/target/NAME/state`: in real time.
pub fn target_state(name: &str) -> String {
    format!("/target/{name}/state")
}

/// `/target/NAME/coasting`: predicted, while no frame comes.
pub fn target_coasting(name: &str) -> String {
    format!("/target/{name}/coasting")
}

/// Whether a topic contains the present state of a target: of a frame, or predicted while none comes.
pub fn is_target_now(topic: &str) -> bool {
    topic.starts_with("/target/") && (topic.ends_with("/state") || topic.ends_with("/coasting"))
}

/// `/target/NAME/smoothed`: from the fixed-lag smoother.
pub fn target_smoothed(name: &str) -> String {
    format!("/target/{name}/smoothed")
}

/// `/target/NAME/paper`: by the paper's method.
pub fn target_paper(name: &str) -> String {
    format!("/target/{name}/paper")
}

/// `/target/NAME/refined`: from the whole flight at once.
pub fn target_refined(name: &str) -> String {
    format!("/target/{name}/refined")
}

/// `/target/NAME/refined_location`: the same for maps.
pub fn target_refined_location(name: &str) -> String {
    format!("/target/{name}/refined_location")
}

/// Whether a topic is written by a refinement.
pub fn is_refined(topic: &str) -> bool {
    let of_target =
        || topic.rsplit('/').next().is_some_and(|what| what == "refined" || what == "refined_location");
    topic == OWNSHIP_REFINED || topic == REFINED || (topic.starts_with("/target/") && of_target())
}

/// Whether a topic is written by the pipeline itself, so that a replay writes it again.
pub fn is_output(topic: &str) -> bool {
    const OUTPUTS: [&str; 14] = [
        GPS_FIX,
        GPS_EPOCH,
        COMPASS_ATTITUDE,
        TF,
        CAMERA_CALIBRATION,
        CAMERA_ANNOTATIONS,
        CAMERA_DETECTIONS,
        DATUM,
        OWNSHIP,
        OWNSHIP_REFINED,
        REFINED,
        FUSION,
        LOG,
        HEALTH,
    ];
    OUTPUTS.contains(&topic) || topic.starts_with("/target/")
}
