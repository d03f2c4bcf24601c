//! ROS 2's bags in the storage `sqlite3`: their two tables, read from SQLite's file format
//! (<https://www.sqlite.org/fileformat2.html>) without its library.

use std::collections::HashMap;
use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;

use super::{BagMessage, Wire};
use windhover_base::time::MonoTime;

pub(super) const MAGIC: &[u8] = b"SQLite format 3\0";
/// Deepest tree: each level holds hundreds of times the one below.
const DEPTH: usize = 12;
/// Longest accepted row.
const MOST_ROW: usize = 1 << 28;

/// A value of a row.
#[derive(Clone, PartialEq, Debug)]
enum Value {
    Null,
    Int(i64),
    Bytes(Vec<u8>),
}

impl Value {
    fn int(&self) -> Option<i64> {
        match self {
            Self::Int(value) => Some(*value),
            _ => None,
        }
    }

    fn text(&self) -> Option<&str> {
        match self {
            Self::Bytes(bytes) => std::str::from_utf8(bytes).ok(),
            _ => None,
        }
    }
}

/// The pages of a file.
struct Pages {
    file: File,
    size: usize,
    usable: usize,
    count: u32,
}

/// Messages of a bag in the order in which they were written.
pub(super) struct SqliteReader {
    pages: Pages,
    topics: HashMap<i64, (Arc<str>, Arc<str>)>,
    walk: Walk,
    pub warnings: Vec<String>,
}

/// A walk over the leaves of a table: pages from the root down, each with its next cell.
#[derive(Default)]
struct Walk {
    path: Vec<(Vec<u8>, u32, usize)>,
    /// Pages that may still be visited: a damaged tree may have cycles.
    left: u32,
}

/// SQLite's integers of up to nine bytes; also returns their length.
fn varint(bytes: &[u8]) -> Option<(u64, usize)> {
    let mut value = 0u64;
    for (k, byte) in bytes.iter().take(9).enumerate() {
        if k == 8 {
            return Some((value << 8 | u64::from(*byte), 9));
        }
        value = value << 7 | u64::from(byte & 0x7f);
        if byte & 0x80 == 0 {
            return Some((value, k + 1));
        }
    }
    None
}

fn u16_at(page: &[u8], at: usize) -> Option<usize> {
    Some(usize::from(u16::from_be_bytes(*page.get(at..)?.first_chunk()?)))
}

fn u32_at(page: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(*page.get(at..)?.first_chunk()?))
}

impl Pages {
    fn open(file: File) -> Option<Self> {
        let mut head = [0; 100];
        file.read_exact_at(&mut head, 0).ok()?;
        let size = match u16_at(&head, 16)? {
            1 => 1 << 16,
            size => size,
        };
        let usable = size.checked_sub(usize::from(head[20]))?;
        if !size.is_power_of_two() || size < 512 || usable < 480 {
            return None;
        }
        let count = u32::try_from(file.metadata().ok()?.len() / size as u64).ok()?;
        Some(Self { file, size, usable, count })
    }

    fn read(&self, number: u32) -> Option<Vec<u8>> {
        let index = u64::from(number.checked_sub(1).filter(|index| *index < self.count)?);
        let mut page = vec![0; self.size];
        self.file.read_exact_at(&mut page, index * self.size as u64).ok()?;
        Some(page)
    }

    /// The row of a leaf's cell, including its overflow pages.
    fn row(&self, page: &[u8], cell: usize) -> Option<(i64, Vec<u8>)> {
        let (length, a) = varint(page.get(cell..)?)?;
        let (id, b) = varint(page.get(cell + a..)?)?;
        let length = usize::try_from(length).ok().filter(|length| *length <= MOST_ROW)?;
        let begin = cell + a + b;
        let most = self.usable - 35;
        if length <= most {
            return Some((id as i64, page.get(begin..begin + length)?.to_vec()));
        }
        let least = (self.usable - 12) * 32 / 255 - 23;
        let here = least + (length - least) % (self.usable - 4);
        let here = if here <= most { here } else { least };
        let mut row = page.get(begin..begin + here)?.to_vec();
        let mut next = u32_at(page, begin + here)?;
        while row.len() < length {
            let more = self.read(next)?;
            next = u32_at(&more, 0)?;
            let taken = (length - row.len()).min(self.usable - 4);
            row.extend_from_slice(&more[4..4 + taken]);
        }
        Some((id as i64, row))
    }
}

/// The values of a row (SQLite: record format).
fn values(row: &[u8]) -> Option<Vec<Value>> {
    let (header, mut at) = varint(row)?;
    let header = usize::try_from(header).ok().filter(|header| *header <= row.len())?;
    let mut body = header;
    let mut values = Vec::new();
    while at < header {
        let (kind, taken) = varint(&row[at..header])?;
        at += taken;
        let length = match kind {
            0 | 8 | 9 => 0,
            1..=4 => kind as usize,
            5 => 6,
            6 | 7 => 8,
            12.. => usize::try_from((kind - 12) / 2).ok()?,
            _ => return None,
        };
        let bytes = row.get(body..body.checked_add(length)?)?;
        body += length;
        values.push(match kind {
            1..=6 => {
                let negative = bytes[0] & 0x80 != 0;
                Value::Int(
                    bytes.iter().fold(if negative { -1 } else { 0 }, |sum, byte| sum << 8 | i64::from(*byte)),
                )
            }
            8 => Value::Int(0),
            9 => Value::Int(1),
            12.. => Value::Bytes(bytes.to_vec()),
            _ => Value::Null,
        });
    }
    Some(values)
}

impl Walk {
    fn from(pages: &Pages, root: u32) -> Self {
        let mut walk = Self { path: Vec::new(), left: pages.count };
        walk.enter(pages, root);
        walk
    }

    fn enter(&mut self, pages: &Pages, number: u32) -> Option<()> {
        self.left = self.left.checked_sub(1)?;
        if self.path.len() < DEPTH {
            self.path.push((pages.read(number)?, number, 0));
        }
        Some(())
    }

    /// The next row; `None` at the end, or `Some(None)` for one that is damaged.
    fn next(&mut self, pages: &Pages) -> Option<Option<(i64, Vec<u8>)>> {
        loop {
            let (page, number, cell) = self.path.last_mut()?;
            let head = if *number == 1 { 100 } else { 0 };
            let count = u16_at(page, head + 3)?;
            let (k, kind) = (*cell, page[head]);
            *cell += 1;
            match kind {
                0x0d if k < count => {
                    let row = u16_at(page, head + 8 + 2 * k).and_then(|at| pages.row(page, at));
                    return Some(row);
                }
                0x05 if k <= count => {
                    let child = match k < count {
                        true => u16_at(page, head + 12 + 2 * k).and_then(|at| u32_at(page, at)),
                        false => u32_at(page, head + 8),
                    };
                    if let Some(child) = child {
                        self.enter(pages, child);
                    }
                }
                _ => {
                    self.path.pop();
                }
            }
        }
    }
}

impl SqliteReader {
    /// A reader of a file whose first bytes were checked; `None` where it does not have the tables of a bag.
    pub(super) fn open(file: File) -> Option<Self> {
        let pages = Pages::open(file)?;
        let roots = roots(&pages);
        let mut topics = HashMap::new();
        let mut walk = Walk::from(&pages, *roots.get("topics")?);
        while let Some(row) = walk.next(&pages) {
            let Some((id, row)) = row else { continue };
            let Some(values) = values(&row) else { continue };
            // id (the row's number), name, type, serialization format, …
            let text = |k: usize| values.get(k).and_then(Value::text);
            if let (Some(name), Some(kind), Some("cdr")) = (text(1), text(2), text(3)) {
                topics.insert(id, (name.into(), kind.into()));
            }
        }
        let walk = Walk::from(&pages, *roots.get("messages")?);
        Some(Self { pages, topics, walk, warnings: Vec::new() })
    }

    /// The next message; `None` at the end.
    pub(super) fn next(&mut self) -> Option<BagMessage> {
        while let Some(row) = self.walk.next(&self.pages) {
            let values = row.and_then(|(_, row)| values(&row));
            // id, topic, time, data.
            if let Some([_, topic, t, Value::Bytes(data)]) = values.as_deref()
                && let Some((topic, t)) = topic.int().zip(t.int())
            {
                if let Some((topic, kind)) = self.topics.get(&topic).cloned() {
                    let t = MonoTime::from_ns(t);
                    return Some(BagMessage { topic, kind, wire: Wire::Cdr, t, data: data.clone() });
                }
            } else if self.warnings.is_empty() {
                self.warnings.push("rows of the bag are damaged and left out".into());
            }
        }
        None
    }
}

/// The root pages of the tables, by name.
fn roots(pages: &Pages) -> HashMap<String, u32> {
    let mut roots = HashMap::new();
    let mut walk = Walk::from(pages, 1);
    while let Some(row) = walk.next(pages) {
        let values = row.and_then(|(_, row)| values(&row));
        // type, name, table, root page, statement.
        if let Some([kind, name, _, root, ..]) = values.as_deref()
            && kind.text() == Some("table")
            && let (Some(name), Some(root)) = (name.text(), root.int())
        {
            roots.insert(name.to_owned(), u32::try_from(root).unwrap_or(0));
        }
    }
    roots
}
