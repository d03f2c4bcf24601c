//! Messages on streams: a length as a varint, then the protobuf message.
//!
//! A message that is longer than its limit ends the stream.

use prost::Message;
use quinn::{RecvStream, SendStream};

/// Longest message on the control and back-fill streams, bytes.
pub const MESSAGE_LIMIT: usize = 4 << 20;
/// Longest thumbnail, bytes.
pub const THUMBNAIL_LIMIT: usize = 1 << 20;
/// First byte of a back-fill stream.
pub const KIND_BACKFILL: u8 = 1;
/// First byte of a thumbnail stream.
pub const KIND_THUMBNAIL: u8 = 2;
/// Number of additions to version 1 of the message format.
pub const MINOR: u32 = 0;

/// Why a stream gave no message.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The stream or its connection ended.
    #[error("the stream ended: {0}")]
    Ended(String),
    /// A length beyond the limit, or bytes that are not a message.
    #[error("bytes that are not a message of the link: {0}")]
    Malformed(String),
}

/// Cuts a byte stream into messages.
#[derive(Debug, Default)]
pub struct Deframer {
    buffer: Vec<u8>,
    start: usize,
}

impl Deframer {
    /// Adds received bytes.
    pub fn push(&mut self, bytes: &[u8]) {
        if self.start > 0 && self.start * 2 > self.buffer.len() {
            self.buffer.drain(..self.start);
            self.start = 0;
        }
        self.buffer.extend_from_slice(bytes);
    }

    /// The next complete message; `None` until there is one.
    pub fn message<M: Message + Default>(&mut self) -> Result<Option<M>, WireError> {
        let rest = &self.buffer[self.start..];
        let Some((length, used)) = length(rest)? else { return Ok(None) };
        let Some(body) = rest.get(used..used + length) else { return Ok(None) };
        let message = M::decode(body).map_err(|e| WireError::Malformed(e.to_string()))?;
        self.start += used + length;
        Ok(Some(message))
    }
}

/// Length prefix: its value and its own length in bytes; `None` where it is incomplete.
fn length(bytes: &[u8]) -> Result<Option<(usize, usize)>, WireError> {
    let mut value = 0_usize;
    for (i, byte) in bytes.iter().take(4).enumerate() {
        value |= usize::from(byte & 0x7f) << (7 * i);
        if value > MESSAGE_LIMIT {
            break;
        }
        if byte & 0x80 == 0 {
            return Ok(Some((value, i + 1)));
        }
    }
    if value > MESSAGE_LIMIT || bytes.len() >= 4 {
        return Err(WireError::Malformed("a length beyond the limit".into()));
    }
    Ok(None)
}

/// Reads messages from a stream.
pub struct Reader {
    stream: RecvStream,
    deframer: Deframer,
}

impl Reader {
    /// A reader of a stream from here on.
    pub fn new(stream: RecvStream) -> Self {
        Self { stream, deframer: Deframer::default() }
    }

    /// The next message; `None` where the stream ended between two.
    pub async fn next<M: Message + Default>(&mut self) -> Result<Option<M>, WireError> {
        loop {
            if let Some(message) = self.deframer.message()? {
                return Ok(Some(message));
            }
            match self.stream.read_chunk(64 << 10, true).await {
                Ok(Some(chunk)) => self.deframer.push(&chunk.bytes),
                Ok(None) => return Ok(None),
                Err(e) => return Err(WireError::Ended(e.to_string())),
            }
        }
    }
}

/// Writes one message.
pub async fn write(stream: &mut SendStream, message: &impl Message) -> Result<(), WireError> {
    stream
        .write_all(&message.encode_length_delimited_to_vec())
        .await
        .map_err(|e| WireError::Ended(e.to_string()))
}

/// First eight bytes of the SHA-256 of a schema.
pub fn schema_hash(schema: &[u8]) -> u64 {
    let digest = ring::digest::digest(&ring::digest::SHA256, schema);
    let mut first = [0_u8; 8];
    first.copy_from_slice(&digest.as_ref()[..8]);
    u64::from_be_bytes(first)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::io::proto::link::{
        Backfill, Extent, Live, Range, Record, Thumbnail, ToPayload, ToStation, Want,
    };
    use crate::io::proto::link::{to_payload, to_station};

    fn record() -> impl Strategy<Value = Record> {
        (any::<u32>(), any::<u32>(), any::<i64>(), any::<i64>(), any::<Vec<u8>>(), any::<u32>()).prop_map(
            |(number, channel, log_time_ns, true_before_ns, data, run)| Record {
                number,
                channel,
                log_time_ns,
                true_before_ns,
                data,
                run,
            },
        )
    }

    proptest! {
        #[test]
        fn messages_survive_any_cutting(records in prop::collection::vec(record(), 0..8), cut in 1_usize..40) {
            let mut bytes = Vec::new();
            for record in &records {
                bytes.extend(record.encode_length_delimited_to_vec());
            }
            let (mut deframer, mut got) = (Deframer::default(), Vec::new());
            for part in bytes.chunks(cut) {
                deframer.push(part);
                while let Some(record) = deframer.message::<Record>().expect("well formed") {
                    got.push(record);
                }
            }
            prop_assert_eq!(got, records);
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
            let mut deframer = Deframer::default();
            deframer.push(&bytes);
            // Each call consumes at least a byte or ends.
            while let Ok(Some(_)) = deframer.message::<ToPayload>() {}
            let mut deframer = Deframer::default();
            deframer.push(&bytes);
            while let Ok(Some(_)) = deframer.message::<Backfill>() {}
            let _ = (Live::decode(&bytes[..]), ToStation::decode(&bytes[..]), Thumbnail::decode(&bytes[..]));
        }
    }

    #[test]
    fn lengths_beyond_the_limit_end_the_stream() {
        let mut deframer = Deframer::default();
        deframer.push(&[0xff, 0xff, 0xff, 0x7f]);
        assert!(matches!(deframer.message::<Record>(), Err(WireError::Malformed(_))));
        let mut deframer = Deframer::default();
        deframer.push(&[0x80, 0x80, 0x80, 0x80, 0x80]);
        assert!(matches!(deframer.message::<Record>(), Err(WireError::Malformed(_))));
    }

    #[test]
    fn an_older_reader_skips_what_a_newer_writer_adds() {
        // A field 15 that this version does not know, and a message kind it does not know.
        let mut bytes = Record { number: 7, run: 1, ..Record::default() }.encode_to_vec();
        bytes.extend([0x7a, 0x02, b'h', b'i']);
        assert_eq!(Record::decode(&bytes[..]).expect("a record").number, 7);
        let unknown_kind = [0x7a, 0x00];
        assert_eq!(ToStation::decode(&unknown_kind[..]).expect("an envelope").body, None);
        let want = ToPayload { body: Some(to_payload::Body::Want(Want { ranges: vec![Range::default()] })) };
        assert_eq!(ToPayload::decode(&want.encode_to_vec()[..]).expect("a want"), want);
        let head = ToStation { body: Some(to_station::Body::Head(Extent::default())) };
        assert_eq!(ToStation::decode(&head.encode_to_vec()[..]).expect("a head"), head);
    }
}
