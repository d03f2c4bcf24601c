//! ROS 1's bags, version 2.0 (<http://wiki.ros.org/Bags/Format/2.0>), record by record; complete or cut off.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read as _};
use std::sync::Arc;

use super::{BagMessage, Wire};
use windhover_base::time::{MonoTime, NS_PER_S};

pub(super) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";
/// Largest accepted header of a record, record, and unpacked chunk.
const MOST_HEADER: u32 = 1 << 16;
const MOST_DATA: u32 = 1 << 28;
/// Most accepted connections.
const MOST_CONNECTIONS: usize = 4096;

const OP_MESSAGE: u8 = 2;
const OP_CHUNK: u8 = 5;
const OP_CONNECTION: u8 = 7;

/// Topic and type of a connection.
type Connection = (Arc<str>, Arc<str>);

/// Messages of a bag in the order of the file.
pub(super) struct Ros1Reader {
    input: BufReader<File>,
    left: u64,
    /// The chunk being read, and the position in it.
    chunk: Option<(Vec<u8>, usize)>,
    connections: HashMap<u32, Connection>,
    pub warnings: Vec<String>,
}

/// The fields of a record's header.
struct Head<'a>(&'a [u8]);

impl<'a> Head<'a> {
    fn get(&self, name: &str) -> Option<&'a [u8]> {
        let mut rest = self.0;
        while let Some((length, after)) = rest.split_first_chunk::<4>() {
            let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
            let field = after.get(..length)?;
            rest = &after[length..];
            let at = field.iter().position(|byte| *byte == b'=')?;
            if &field[..at] == name.as_bytes() {
                return Some(&field[at + 1..]);
            }
        }
        None
    }

    fn op(&self) -> Option<u8> {
        self.get("op")?.first().copied()
    }

    fn u32(&self, name: &str) -> Option<u32> {
        Some(u32::from_le_bytes(self.get(name)?.try_into().ok()?))
    }

    fn text(&self, name: &str) -> Option<Arc<str>> {
        Some(String::from_utf8_lossy(self.get(name)?).into())
    }
}

/// Header and data of the record at the start of these bytes, and its length.
fn split(bytes: &[u8]) -> Option<(Head<'_>, &[u8], usize)> {
    let sized = |bytes: &[u8]| Some(u32::from_le_bytes(*bytes.first_chunk::<4>()?) as usize);
    let header = sized(bytes)?;
    let data_at = 4usize.checked_add(header)?;
    let data = sized(bytes.get(data_at..)?)?;
    let end = data_at.checked_add(4)?.checked_add(data)?;
    Some((Head(&bytes[4..data_at]), bytes.get(data_at + 4..end)?, end))
}

impl Ros1Reader {
    /// A reader of a file whose first line was checked.
    pub(super) fn new(file: File) -> std::io::Result<Self> {
        let left = file.metadata()?.len().saturating_sub(MAGIC.len() as u64);
        let mut input = BufReader::with_capacity(1 << 16, file);
        input.read_exact(&mut [0; MAGIC.len()])?;
        Ok(Self { input, left, chunk: None, connections: HashMap::new(), warnings: Vec::new() })
    }

    fn sized(&mut self, most: u32) -> Option<Vec<u8>> {
        let mut length = [0; 4];
        self.input.read_exact(&mut length).ok()?;
        let length = u32::from_le_bytes(length);
        self.left = self.left.checked_sub(4 + u64::from(length))?;
        if length > most {
            return None;
        }
        let mut body = vec![0; length as usize];
        self.input.read_exact(&mut body).ok()?;
        Some(body)
    }

    /// The next message; `None` at the end of the file.
    pub(super) fn next(&mut self) -> Option<BagMessage> {
        loop {
            if let Some((records, at)) = self.chunk.take() {
                if let Some((head, data, length)) = split(&records[at..]) {
                    let message = self.take(&head, data);
                    self.chunk = Some((records, at + length));
                    if message.is_some() {
                        return message;
                    }
                }
                continue;
            }
            if self.left == 0 {
                return None;
            }
            let Some((header, data)) =
                self.sized(MOST_HEADER).and_then(|h| Some((h, self.sized(MOST_DATA)?)))
            else {
                self.warnings.push("the bag is cut off or damaged: read to its last whole record".into());
                self.left = 0;
                return None;
            };
            let head = Head(&header);
            if head.op() == Some(OP_CHUNK) {
                match unpack(&head, data) {
                    Ok(records) => self.chunk = Some((records, 0)),
                    Err(why) => self.warnings.push(format!("a chunk is left out: {why}")),
                }
                continue;
            }
            let message = self.take(&head, &data);
            if message.is_some() {
                return message;
            }
        }
    }

    fn take(&mut self, head: &Head<'_>, data: &[u8]) -> Option<BagMessage> {
        match head.op()? {
            OP_CONNECTION if self.connections.len() < MOST_CONNECTIONS => {
                let (topic, kind) = (head.text("topic")?, Head(data).text("type")?);
                self.connections.insert(head.u32("conn")?, (topic, kind));
                None
            }
            OP_MESSAGE => {
                let (topic, kind) = self.connections.get(&head.u32("conn")?)?.clone();
                let (seconds, nanos) = head.get("time")?.split_at_checked(4)?;
                let word = |bytes: &[u8]| Some(i64::from(u32::from_le_bytes(bytes.try_into().ok()?)));
                let t = MonoTime::from_ns(word(seconds)? * NS_PER_S + word(nanos)?);
                Some(BagMessage { topic, kind, wire: Wire::Ros1, t, data: data.to_vec() })
            }
            _ => None,
        }
    }
}

/// The records of a chunk.
fn unpack(head: &Head<'_>, data: Vec<u8>) -> Result<Vec<u8>, String> {
    let compression = head.text("compression").unwrap_or_default();
    let size = head.u32("size").filter(|size| *size <= MOST_DATA).ok_or("its size is not plausible")?;
    let mut records = Vec::new();
    let most = u64::from(size);
    match &*compression {
        "none" => return Ok(data),
        "lz4" => lz4::Decoder::new(&data[..])
            .and_then(|unpacked| unpacked.take(most).read_to_end(&mut records))
            .map_err(|error| error.to_string())?,
        "bz2" => bzip2::read::BzDecoder::new(&data[..])
            .take(most)
            .read_to_end(&mut records)
            .map_err(|error| error.to_string())?,
        other => return Err(format!("compressed as {other:?}, which is not supported")),
    };
    Ok(records)
}
