//! The protobuf messages of captures, flights and the link, and their schemas.

/// Foxglove's schemas, by their published names and numbers.
#[expect(missing_docs, reason = "documented by their publisher")]
pub mod foxglove {
    include!(concat!(env!("OUT_DIR"), "/foxglove.rs"));
}

/// Windhover's own messages.
pub mod windhover {
    include!(concat!(env!("OUT_DIR"), "/windhover.rs"));
}

/// The messages of the wireless link.
#[expect(missing_docs, reason = "documented where they are defined, in link.proto")]
pub mod link {
    include!(concat!(env!("OUT_DIR"), "/windhover.link.rs"));
}

mod sound;

use prost::Message as _;
use prost_types::{FileDescriptorSet, Timestamp};

use windhover_base::time::{MonoTime, NS_PER_S};

/// Every schema of the program as one descriptor set.
const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// The descriptor set of one package with all its imports, as MCAP requires for a protobuf schema.
pub fn schema_of_package(package: &str) -> Vec<u8> {
    let all = FileDescriptorSet::decode(DESCRIPTORS).expect("written by the build from the same schemas");
    let file = all.file.iter().filter(|f| f.package() == package || f.package() == "google.protobuf");
    FileDescriptorSet { file: file.cloned().collect() }.encode_to_vec()
}

/// Host time as a protobuf timestamp.
pub fn timestamp(t: MonoTime) -> Timestamp {
    Timestamp { seconds: t.ns().div_euclid(NS_PER_S), nanos: t.ns().rem_euclid(NS_PER_S) as i32 }
}

/// A protobuf timestamp as host time; zero where absent.
pub fn host_time(t: Option<&Timestamp>) -> MonoTime {
    t.map_or(MonoTime::default(), |t| {
        MonoTime::from_ns(t.seconds.saturating_mul(NS_PER_S).saturating_add(i64::from(t.nanos)))
    })
}
