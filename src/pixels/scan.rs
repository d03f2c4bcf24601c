//! Checks that every block of a JPEG picture is present, before its pixels are decoded.
//!
//! A decoder continues where bytes of a scan are lost, and puts the following blocks in the wrong places. So the scan
//! is walked first, code by code: it must consist of all blocks and nothing else. Where the picture has restart
//! markers, their numbers show which intervals are lost or damaged; these are replaced by flat grey and reported, the
//! others stay in their places. Without restart markers a damaged picture cannot be used below the damage, and the
//! start of the damage is not known.
//!
//! Motion JPEG may omit the Huffman tables (USB Video Class, AVI): the standard ones are inserted.
//!
//! Source: ITU-T T.81 (markers B.1, Huffman decoding F.2.2, restarts E.2.4, standard tables K.3).

use std::borrow::Cow;

use super::huffman::{Bits, Code, STANDARD_TABLES, Writer, standard};

/// Largest share of a picture that may be missing.
const MOST_MISSING: f64 = 0.5;
/// Bytes of zeros after the last block with which some cameras pad.
const FILLED_MAX: usize = 64;

/// A lost part of a picture, in pixels: from the first corner to before the second.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct MissingPart {
    /// First column and row.
    pub from: (usize, usize),
    /// Column and row after the last.
    pub to: (usize, usize),
}

/// A picture that can be decoded.
pub(super) struct Checked<'a> {
    pub(super) bytes: Cow<'a, [u8]>,
    pub(super) missing: Vec<MissingPart>,
}

/// One component of the scan.
#[derive(Clone, Copy, Default, Debug)]
struct Component {
    id: u8,
    across: usize,
    down: usize,
    quantization: usize,
    dc: usize,
    ac: usize,
}

/// Largest distance of a block's level from the middle, before quantization (eight bits, A.3.3).
const LEVEL_MAX: i32 = 1024;

/// Data before the scan.
#[derive(Default)]
struct Header {
    width: usize,
    height: usize,
    components: Vec<Component>,
    /// Blocks' groups between restarts; 0 for none.
    restart: usize,
    dc: [Option<Code>; 4],
    ac: [Option<Code>; 4],
    /// Quantization steps of the levels, for each quantization table.
    steps: [u16; 4],
    has_tables: bool,
    /// Where the coded picture begins.
    scan: usize,
}

/// Checks the scan of a sequential picture. Other kinds are passed on where their end is present.
pub(super) fn checked(bytes: &[u8]) -> Result<Checked<'_>, String> {
    let as_it_is = |bytes| Checked { bytes: Cow::Borrowed(bytes), missing: Vec::new() };
    let Some(mut header) = Header::read(bytes)? else {
        let has_end = bytes.windows(2).any(|pair| pair == [0xFF, 0xD9]);
        return if has_end { Ok(as_it_is(bytes)) } else { Err("it is incomplete".to_owned()) };
    };
    if !header.has_tables {
        let [dc, chroma_dc, ac, chroma_ac] = standard();
        (header.dc, header.ac) =
            ([Some(dc), Some(chroma_dc), None, None], [Some(ac), Some(chroma_ac), None, None]);
    }
    let mut parts = Part::of_scan(&bytes[header.scan..], header.scan);
    // Some end with a restart that nothing follows.
    parts.pop_if(|last| last.from == last.to && header.restart > 0);
    let placed = header.place(bytes, &parts)?;
    let missing: Vec<usize> = (0..placed.len()).filter(|index| placed[*index].is_none()).collect();
    if missing.is_empty() && header.has_tables {
        return Ok(as_it_is(bytes));
    }
    if placed.len() == 1 && !missing.is_empty() {
        return Err("bytes of its picture are lost or damaged".to_owned());
    }
    if missing.len() as f64 > MOST_MISSING * placed.len() as f64 {
        return Err(format!("{} of its {} parts are damaged or missing", missing.len(), placed.len()));
    }
    let bytes = header.put_together(bytes, &placed)?;
    let missing = missing.into_iter().flat_map(|index| header.pixels_of(index)).collect();
    Ok(Checked { bytes: Cow::Owned(bytes), missing })
}

fn u16_at(bytes: &[u8], at: usize) -> Result<usize, String> {
    let pair = bytes.get(at..at + 2).ok_or("its header is incomplete")?;
    Ok(usize::from(pair[0]) << 8 | usize::from(pair[1]))
}

impl Header {
    /// Reads up to the scan; `None` where the picture is not one sequential scan of eight bits.
    fn read(bytes: &[u8]) -> Result<Option<Self>, String> {
        if !bytes.starts_with(&[0xFF, 0xD8]) {
            return Err("it does not begin as JPEG".to_owned());
        }
        let (mut header, mut at) = (Self::default(), 2);
        loop {
            let marker = match bytes.get(at..at + 2).ok_or("its header is incomplete")? {
                [0xFF, 0xFF] => {
                    at += 1;
                    continue;
                }
                [0xFF, marker] => *marker,
                _ => return Err("its header is damaged".to_owned()),
            };
            let length = u16_at(bytes, at + 2)?;
            let body = bytes.get(at + 4..at + 2 + length).ok_or("its header is incomplete")?;
            at += 2 + length;
            match marker {
                0xC4 => header.tables(body)?,
                0xDB => header.quantization(body)?,
                0xC0 | 0xC1 => header.frame(body)?,
                0xC2 | 0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF => return Ok(None),
                0xDD => header.restart = u16_at(body, 0)?,
                0xDA => {
                    header.scan = at;
                    return Ok(header.scan_of(body)?.then_some(header));
                }
                0xD9 => return Err("it ends before its picture".to_owned()),
                _ => {}
            }
        }
    }

    fn tables(&mut self, mut body: &[u8]) -> Result<(), String> {
        while let Some((&class, rest)) = body.split_first() {
            let counts = rest.get(..16).ok_or("a Huffman table is incomplete")?;
            let total: usize = counts.iter().map(|count| usize::from(*count)).sum();
            let symbols = rest.get(16..16 + total).ok_or("a Huffman table is incomplete")?;
            let code = Code::new(counts, symbols).ok_or("a Huffman table is damaged")?;
            let tables = if class >> 4 == 0 { &mut self.dc } else { &mut self.ac };
            *tables.get_mut(usize::from(class & 15)).ok_or("a Huffman table has an invalid number")? =
                Some(code);
            self.has_tables = true;
            body = &rest[16 + total..];
        }
        Ok(())
    }

    fn quantization(&mut self, mut body: &[u8]) -> Result<(), String> {
        while let Some((&class, rest)) = body.split_first() {
            let wide = class >> 4 != 0;
            let table =
                rest.get(..if wide { 128 } else { 64 }).ok_or("a quantization table is incomplete")?;
            let step = if wide { u16_at(table, 0)? as u16 } else { u16::from(table[0]) };
            *self
                .steps
                .get_mut(usize::from(class & 15))
                .ok_or("a quantization table has an invalid number")? = step;
            body = &rest[table.len()..];
        }
        Ok(())
    }

    fn frame(&mut self, body: &[u8]) -> Result<(), String> {
        (self.height, self.width) = (u16_at(body, 1)?, u16_at(body, 3)?);
        let eight_bits = body.first() == Some(&8);
        let components = body.get(6..).unwrap_or_default().chunks_exact(3);
        self.components = components
            .map(|c| {
                let (across, down) = (usize::from(c[1] >> 4), usize::from(c[1] & 15));
                let quantization = usize::from(c[2] & 3);
                Component { id: c[0], across, down, quantization, ..Component::default() }
            })
            .collect();
        let sampling = |c: &Component| (1..=4).contains(&c.across) && (1..=4).contains(&c.down);
        let sound = eight_bits && self.width > 0 && self.height > 0 && self.components.iter().all(sampling);
        if sound && !self.components.is_empty() {
            Ok(())
        } else {
            Err("its frame header is damaged".to_owned())
        }
    }

    /// Takes the scan's tables; returns whether it has all components.
    fn scan_of(&mut self, body: &[u8]) -> Result<bool, String> {
        let count = usize::from(*body.first().ok_or("its scan header is incomplete")?);
        for entry in body.get(1..1 + 2 * count).ok_or("its scan header is incomplete")?.chunks_exact(2) {
            let component = self.components.iter_mut().find(|component| component.id == entry[0]);
            let component = component.ok_or("its scan is of an undefined component")?;
            (component.dc, component.ac) = (usize::from(entry[1] >> 4 & 3), usize::from(entry[1] & 3));
        }
        if let [one] = self.components.as_mut_slice() {
            // A single component has one block after the other, whatever its sampling.
            (one.across, one.down) = (1, 1);
        }
        Ok(count == self.components.len())
    }

    /// Pixels across and down of a group of blocks.
    fn group_px(&self) -> (usize, usize) {
        let most = |of: fn(&Component) -> usize| 8 * self.components.iter().map(of).max().unwrap_or(1);
        (most(|c| c.across), most(|c| c.down))
    }

    /// Groups of blocks in a row, and in all.
    fn groups(&self) -> (usize, usize) {
        let (across, down) = self.group_px();
        let row = self.width.div_ceil(across);
        (row, row * self.height.div_ceil(down))
    }

    /// Groups of the interval of this index.
    fn groups_of(&self, index: usize) -> std::ops::Range<usize> {
        let (_, all) = self.groups();
        let length = if self.restart == 0 { all } else { self.restart };
        (index * length).min(all)..((index + 1) * length).min(all)
    }

    fn pixels_of(&self, index: usize) -> Vec<MissingPart> {
        let ((row, _), (across, down)) = (self.groups(), self.group_px());
        let mut groups = self.groups_of(index);
        let mut parts = Vec::new();
        while let Some(first) = groups.clone().next() {
            let after = (first / row * row + row).min(groups.end);
            let (left, top) = (first % row * across, first / row * down);
            let right = (left + (after - first) * across).min(self.width);
            parts.push(MissingPart { from: (left, top), to: (right, (top + down).min(self.height)) });
            groups.start = after;
        }
        parts
    }

    /// Assigns a part to each interval of the picture, where it is present and complete.
    fn place(&self, bytes: &[u8], parts: &[Part]) -> Result<Vec<Option<Part>>, String> {
        let (_, all) = self.groups();
        let count = if self.restart == 0 { 1 } else { all.div_ceil(self.restart) };
        let damaged = || "bytes of its picture are lost or damaged".to_owned();
        let (mut index, mut holes, mut hole_at) = (0, 0, 0);
        let mut places = Vec::with_capacity(parts.len());
        let mut unknown = vec![false; parts.len()];
        for (part, unknown) in parts.iter().zip(&mut unknown) {
            places.push(index);
            if let Some(number) = part.restart {
                let skipped = (usize::from(number) + 8 - index % 8) % 8;
                if skipped > 0 {
                    // Even where it is complete: intervals before or after it may be lost.
                    *unknown = true;
                    (holes, hole_at) = (holes + 1, places.len());
                }
                index += 1 + skipped;
            }
        }
        let last = *places.last().ok_or_else(damaged)?;
        let lacking = count.checked_sub(last + 1).ok_or_else(damaged)?;
        let mut scratch = Vec::new();
        let mut whole = |part: &Part, index: usize| {
            self.is_whole(
                part.unstuffed(bytes, &mut scratch),
                self.groups_of(index).len(),
                index + 1 == count,
            )
        };
        if lacking > 0 {
            let cut = parts.last().is_some_and(|part| !whole(part, last));
            // A gap of more than eight intervals follows from the total number; two such gaps cannot be distinguished.
            match (holes, cut) {
                (0, true) => {}
                (1, false) if lacking.is_multiple_of(8) => {
                    places[hole_at..].iter_mut().for_each(|place| *place += lacking);
                }
                _ => return Err(damaged()),
            }
        }
        let mut placed = vec![None; count];
        for ((part, index), unknown) in parts.iter().zip(places).zip(unknown) {
            placed[index] = (!unknown && whole(part, index)).then_some(*part);
        }
        Ok(placed)
    }

    /// Whether these bytes are exactly this many groups of blocks.
    fn is_whole(&self, bytes: &[u8], groups: usize, last: bool) -> bool {
        let mut bits = Bits::new(bytes);
        let mut levels = vec![0; self.components.len()];
        for _ in 0..groups {
            for (component, level) in self.components.iter().zip(&mut levels) {
                // One more for the quantizer's rounding.
                let most = LEVEL_MAX / i32::from(self.steps[component.quantization].max(1)) + 1;
                let (Some(dc), Some(ac)) = (&self.dc[component.dc], &self.ac[component.ac]) else {
                    return false;
                };
                for _ in 0..component.across * component.down {
                    if !bits.block(dc, ac, level) || level.abs() > most {
                        return false;
                    }
                }
            }
        }
        bits.is_at_end(if last { FILLED_MAX } else { 0 })
    }

    /// The picture with its tables, and grey in the missing intervals.
    fn put_together(&self, bytes: &[u8], placed: &[Option<Part>]) -> Result<Vec<u8>, String> {
        let mut out = Vec::with_capacity(bytes.len() + STANDARD_TABLES.len());
        out.extend_from_slice(&bytes[..2]);
        if !self.has_tables {
            out.extend_from_slice(STANDARD_TABLES);
        }
        out.extend_from_slice(&bytes[2..self.scan]);
        for (index, part) in placed.iter().enumerate() {
            match part {
                Some(part) => out.extend_from_slice(&bytes[part.from..part.to]),
                None => self.grey(self.groups_of(index).len(), &mut out)?,
            }
            let is_last = index + 1 == placed.len();
            out.extend_from_slice(&[0xFF, if is_last { 0xD9 } else { 0xD0 + (index % 8) as u8 }]);
        }
        Ok(out)
    }

    /// Appends groups of flat blocks.
    fn grey(&self, groups: usize, out: &mut Vec<u8>) -> Result<(), String> {
        let mut writer = Writer::new(out);
        let code = |table: &Option<Code>| table.as_ref().and_then(|code| code.of(0));
        for _ in 0..groups {
            for component in &self.components {
                let codes = code(&self.dc[component.dc]).zip(code(&self.ac[component.ac]));
                let (same, end) =
                    codes.ok_or("parts of it are damaged, and its tables have no code for grey")?;
                for _ in 0..component.across * component.down {
                    writer.write(same);
                    writer.write(end);
                }
            }
        }
        writer.finish();
        Ok(())
    }
}

/// The bytes between two markers of the scan.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
struct Part {
    from: usize,
    to: usize,
    /// The restart marker that follows.
    restart: Option<u8>,
}

impl Part {
    /// The parts of a scan that begins at `at` of its picture.
    fn of_scan(scan: &[u8], at: usize) -> Vec<Self> {
        let (mut parts, mut from, mut here) = (Vec::new(), 0, 0);
        while let Some(next) = scan[here..].iter().position(|byte| *byte == 0xFF).map(|n| here + n) {
            let marker = scan[next..].iter().find(|byte| **byte != 0xFF);
            match marker {
                Some(0) => here = next + 2,
                Some(number @ 0xD0..=0xD7) => {
                    parts.push(Self { from: at + from, to: at + next, restart: Some(number & 7) });
                    here = next + 2;
                    from = here;
                }
                _ => {
                    parts.push(Self { from: at + from, to: at + next, restart: None });
                    return parts;
                }
            }
        }
        parts.push(Self { from: at + from, to: at + scan.len(), restart: None });
        parts
    }

    /// Its bytes without the stuffed zeros after each 255.
    fn unstuffed<'a>(&self, bytes: &[u8], scratch: &'a mut Vec<u8>) -> &'a [u8] {
        scratch.clear();
        let mut rest = &bytes[self.from..self.to];
        while let Some(at) = rest.iter().position(|byte| *byte == 0xFF) {
            scratch.extend_from_slice(&rest[..=at]);
            rest = rest.get(at + 2..).unwrap_or_default();
        }
        scratch.extend_from_slice(rest);
        scratch
    }
}
