//! Identity of the images' source: MISB ST 1204's core identifier.

use ring::digest::{Context, SHA1_FOR_LEGACY_USE_ONLY};

/// Version of ST 1204, and the content: a sensor and a platform, both with a generated ("virtual") identifier.
const HEAD: [u8; 2] = [1, 0x50];
/// Our namespace of identifiers (RFC 9562, version 5).
const NAMESPACE: [u8; 16] = *b"windhover core i";

/// The identifier of a camera and its platform: equal for equal descriptions of the camera.
pub fn core_id(camera: &str) -> [u8; 34] {
    let mut id = [0; 34];
    id[..2].copy_from_slice(&HEAD);
    id[2..18].copy_from_slice(&named(&["sensor", camera]));
    id[18..].copy_from_slice(&named(&["platform", camera]));
    id
}

/// A UUID from a name (RFC 9562, 5.5).
fn named(parts: &[&str]) -> [u8; 16] {
    let mut hash = Context::new(&SHA1_FOR_LEGACY_USE_ONLY);
    hash.update(&NAMESPACE);
    parts.iter().for_each(|part| hash.update(part.as_bytes()));
    let mut id = [0; 16];
    id.copy_from_slice(&hash.finish().as_ref()[..16]);
    id[6] = id[6] & 0x0f | 0x50;
    id[8] = id[8] & 0x3f | 0x80;
    id
}
