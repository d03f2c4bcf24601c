//! The types of ROS 2 messages that are written: names, hashes, definitions.

use std::collections::BTreeSet;
use std::fmt::Write as _;

/// Every type with the types of its fields, `MSG: package/Name` before each.
const DEFINITIONS: &str = include_str!("definitions.msg");

/// One row for each type: its package, its name, its hash (REP-2016, of the distribution Jazzy; the same in every later
/// one so far).
macro_rules! types {
    ($($(#[$doc:meta])* $kind:ident: $package:literal, $name:literal, $hash:literal;)+) => {
        /// A type of message.
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
        pub enum RosType {
            $($(#[$doc])* $kind,)+
        }

        impl RosType {
            /// Every type.
            pub const ALL: &'static [Self] = &[$(Self::$kind),+];

            /// Its full name.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => concat!($package, "/msg/", $name),)+
                }
            }

            /// The hash of its description.
            pub const fn hash(self) -> &'static str {
                match self {
                    $(Self::$kind => concat!("RIHS01_", $hash),)+
                }
            }

            const fn short_name(self) -> &'static str {
                match self {
                    $(Self::$kind => concat!($package, "/", $name),)+
                }
            }
        }
    };
}

types! {
    /// Pose and velocity.
    Odometry: "nav_msgs", "Odometry", "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0";
    /// A position on the Earth.
    NavSatFix: "sensor_msgs", "NavSatFix", "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404";
    /// Attitude, rates, specific forces.
    Imu: "sensor_msgs", "Imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b";
    /// A compressed image.
    CompressedImage: "sensor_msgs", "CompressedImage", "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a";
    /// An uncompressed image.
    Image: "sensor_msgs", "Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";
    /// A lens.
    CameraInfo: "sensor_msgs", "CameraInfo", "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275";
    /// Transforms between frames.
    TfMessage: "tf2_msgs", "TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
    /// Markers in an image.
    AprilTagDetectionArray: "apriltag_msgs", "AprilTagDetectionArray", "6016bfe513a7c741ccbdbc6419ed6c4cabfe5f11271a96555fbf26565c6b9826";
    /// State of the parts.
    DiagnosticArray: "diagnostic_msgs", "DiagnosticArray", "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e";
    /// A line of the log.
    Log: "rcl_interfaces", "Log", "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac";
}

impl RosType {
    /// Its definition and those of all types of its fields, as bags contain them (encoding `ros2msg`).
    pub fn definition(self) -> String {
        let mut written = BTreeSet::from([self.short_name()]);
        let mut waiting = vec![self.short_name()];
        let mut text = String::new();
        while let Some(name) = waiting.pop() {
            let body = body_of(name);
            if !text.is_empty() {
                // Writing into a String cannot fail.
                let _ = writeln!(text, "{}\nMSG: {name}", "=".repeat(80));
            }
            text += body;
            waiting.extend(parts(body).filter(|part| written.insert(part)));
        }
        text
    }
}

/// The lines of one type.
fn body_of(name: &str) -> &'static str {
    let mut bodies = DEFINITIONS.split("MSG: ").filter_map(|block| block.split_once('\n'));
    bodies.find(|(head, _)| *head == name).expect("every type is defined").1
}

/// The types of other messages among the fields.
fn parts(body: &'static str) -> impl Iterator<Item = &'static str> {
    let kind = |line: &'static str| line.split_whitespace().next()?.split('[').next();
    body.lines().filter_map(kind).filter(|kind| kind.contains('/'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_definition_holds_every_part_once() {
        for &kind in RosType::ALL {
            let text = kind.definition();
            let mut defined: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("MSG: ")).collect();
            defined.push(kind.short_name());
            let unique: BTreeSet<&str> = defined.iter().copied().collect();
            assert_eq!(unique.len(), defined.len(), "{text}");
            let named: BTreeSet<&str> = defined.iter().flat_map(|name| parts(body_of(name))).collect();
            assert!(named.is_subset(&unique), "{}: {named:?}", kind.name());
        }
        assert!(
            RosType::Odometry.definition().starts_with("std_msgs/Header header\nstring child_frame_id\n")
        );
    }

    /// Numbers of types in a type description (`type_description_interfaces/msg/FieldType`): of one value, of an array
    /// of fixed length, of a sequence.
    fn described(field: &str) -> Option<String> {
        const PLAIN: [(&str, u32); 13] = [
            ("int8", 2),
            ("uint8", 3),
            ("int16", 4),
            ("uint16", 5),
            ("int32", 6),
            ("uint32", 7),
            ("int64", 8),
            ("uint64", 9),
            ("float32", 10),
            ("float64", 11),
            ("bool", 15),
            ("byte", 16),
            ("string", 17),
        ];
        let mut words = field.split_whitespace();
        let (kind, name) = (words.next()?, words.next()?);
        let (kind, length) = kind
            .strip_suffix(']')
            .and_then(|kind| kind.split_once('['))
            .map_or((kind, None), |(k, n)| (k, Some(n)));
        let plain = PLAIN.iter().find(|(plain, _)| *plain == kind).map(|(_, number)| *number);
        let nested = if plain.is_some() { String::new() } else { kind.replacen('/', "/msg/", 1) };
        let (beyond, capacity) = match length {
            None => (0, "0"),
            Some("") => (144, "0"),
            Some(length) => (48, length),
        };
        let number = plain.unwrap_or(1) + beyond;
        // A constant has a value and is no field.
        (!field.contains('=')).then(|| {
            format!(
                "{{\"name\": \"{name}\", \"type\": {{\"type_id\": {number}, \"capacity\": {capacity}, \
                 \"string_capacity\": 0, \"nested_type_name\": \"{nested}\"}}}}"
            )
        })
    }

    fn description(name: &str, body: &str) -> String {
        let fields: Vec<String> = body.lines().filter_map(described).collect();
        let name = name.replacen('/', "/msg/", 1);
        format!("{{\"type_name\": \"{name}\", \"fields\": [{}]}}", fields.join(", "))
    }

    /// The hash of REP-2016: SHA-256 of the type description as JSON, with those of all types of its fields in order.
    fn hashed(name: &str, body: &'static str) -> String {
        let mut nested = BTreeSet::new();
        let mut waiting: Vec<&str> = parts(body).collect();
        while let Some(part) = waiting.pop() {
            if nested.insert(part) {
                waiting.extend(parts(body_of(part)));
            }
        }
        let nested: Vec<String> = nested.iter().map(|part| description(part, body_of(part))).collect();
        let text = format!(
            "{{\"type_description\": {}, \"referenced_type_descriptions\": [{}]}}",
            description(name, body),
            nested.join(", ")
        );
        let digest = ring::digest::digest(&ring::digest::SHA256, text.as_bytes());
        digest.as_ref().iter().fold("RIHS01_".to_owned(), |all, byte| all + &format!("{byte:02x}"))
    }

    #[test]
    fn hashes_are_those_of_the_definitions() {
        // As ROS publishes it in rmw_zenoh's design document.
        assert_eq!(
            hashed("std_msgs/String", "string data\n"),
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
        for &kind in RosType::ALL {
            assert_eq!(hashed(kind.short_name(), body_of(kind.short_name())), kind.hash(), "{}", kind.name());
        }
    }
}
