//! Plain CDR, little endian, as ROS 2 serialises messages (OMG DDSI-RTPS 2.5, 10.2; XCDR version 1): every value
//! aligned to its own size from the start of the body.

/// Encapsulation header of little-endian plain CDR.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A message being serialised.
#[derive(Clone, Debug)]
pub(super) struct CdrWriter(Vec<u8>);

impl CdrWriter {
    pub(super) fn new() -> Self {
        Self(HEADER.to_vec())
    }

    pub(super) fn finish(self) -> Vec<u8> {
        self.0
    }

    /// Pads to a multiple of the next value's size.
    fn align(&mut self, size: usize) {
        let body = self.0.len() - HEADER.len();
        self.0.resize(HEADER.len() + body.next_multiple_of(size), 0);
    }

    pub(super) fn u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub(super) fn i8(&mut self, value: i8) {
        self.0.extend(value.to_le_bytes());
    }

    pub(super) fn u16(&mut self, value: u16) {
        self.align(2);
        self.0.extend(value.to_le_bytes());
    }

    pub(super) fn i32(&mut self, value: i32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub(super) fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub(super) fn f32(&mut self, value: f32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }

    pub(super) fn f64(&mut self, value: f64) {
        self.align(8);
        self.0.extend(value.to_le_bytes());
    }

    /// An array of fixed length.
    pub(super) fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.f64(*value));
    }

    /// The length of the sequence that follows. Our messages are far below the limit.
    pub(super) fn length(&mut self, length: usize) {
        self.u32(u32::try_from(length).expect("less than 4 GiB"));
    }

    /// Length with the closing zero, text, zero. A zero inside the text would end it early for its reader, so it is
    /// left out.
    pub(super) fn string(&mut self, text: &str) {
        let bytes = text.bytes().filter(|byte| *byte != 0);
        self.length(bytes.clone().count() + 1);
        self.0.extend(bytes);
        self.0.push(0);
    }

    pub(super) fn bytes(&mut self, bytes: &[u8]) {
        self.length(bytes.len());
        self.0.extend_from_slice(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_stand_at_multiples_of_their_size() {
        let mut cdr = CdrWriter::new();
        cdr.u8(7);
        cdr.u16(0x0102);
        cdr.string("ab");
        cdr.f64(1.0);
        let body = cdr.finish().split_off(4);
        assert_eq!(body[..4], [7, 0, 2, 1], "u16 at 2");
        assert_eq!(body[4..11], [3, 0, 0, 0, b'a', b'b', 0], "string at 4");
        assert_eq!(body[11..16], [0; 5], "padding");
        assert_eq!(body[16..], 1.0_f64.to_le_bytes());
    }
}
