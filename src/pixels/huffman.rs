//! Huffman codes of JPEG: walking over coded blocks without decoding their pixels.
//!
//! Source: ITU-T T.81, annexes C (codes), F.2.2 (decoding), K.3 (standard tables).

/// Bits of a code that are looked up at once.
const QUICK: u32 = 10;
/// Longest code.
const LONGEST: usize = 16;

/// One table.
pub(super) struct Code {
    /// By the next [`QUICK`] bits: length of the code and its symbol; length 0 where it is longer.
    quick: Vec<(u8, u8)>,
    /// By length minus one: the first code beyond those of this length, left-aligned to 16 bits.
    beyond: [u32; LONGEST],
    /// By length minus one: index of a code's symbol, minus the code.
    offset: [i32; LONGEST],
    symbols: Vec<u8>,
}

impl Code {
    /// A table from the number of codes of each length, and their symbols; `None` where these are not a valid code.
    pub(super) fn new(counts: &[u8], symbols: &[u8]) -> Option<Self> {
        let mut this = Self {
            quick: vec![(0, 0); 1 << QUICK],
            beyond: [0; LONGEST],
            offset: [0; LONGEST],
            symbols: symbols.to_vec(),
        };
        let (mut code, mut index) = (0u32, 0usize);
        for length in 1..=LONGEST {
            let count = usize::from(*counts.get(length - 1)?);
            this.offset[length - 1] = index as i32 - code as i32;
            for symbol in symbols.get(index..index + count)? {
                if code >> length != 0 {
                    return None;
                }
                if length <= QUICK as usize {
                    let spare = QUICK as usize - length;
                    let first = (code as usize) << spare;
                    this.quick[first..first + (1 << spare)].fill((length as u8, *symbol));
                }
                code += 1;
            }
            index += count;
            this.beyond[length - 1] = code << (LONGEST - length);
            code <<= 1;
        }
        Some(this)
    }

    /// The code of a symbol: its bits and their number.
    pub(super) fn of(&self, symbol: u8) -> Option<(u32, u32)> {
        let index = self.symbols.iter().position(|known| *known == symbol)? as i32;
        let mut first = 0;
        for length in 1..=LONGEST {
            let end = (self.beyond[length - 1] >> (LONGEST - length)) as i32 + self.offset[length - 1];
            if (first..end).contains(&index) {
                return Some(((index - self.offset[length - 1]) as u32, length as u32));
            }
            first = end;
        }
        None
    }

    /// The next symbol and its length, from the next 16 bits.
    fn next(&self, bits: u32) -> Option<(u32, u8)> {
        let (length, symbol) = self.quick[(bits >> (LONGEST as u32 - QUICK)) as usize];
        if length > 0 {
            return Some((u32::from(length), symbol));
        }
        let length = (QUICK as usize + 1..=LONGEST).find(|length| bits < self.beyond[length - 1])?;
        let index = (bits >> (LONGEST - length)) as i32 + self.offset[length - 1];
        Some((length as u32, *self.symbols.get(usize::try_from(index).ok()?)?))
    }
}

/// Bits of coded blocks, without stuffing.
pub(super) struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    hold: u64,
    held: u32,
    /// Bits used so far.
    used: usize,
}

impl<'a> Bits<'a> {
    pub(super) const fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, hold: 0, held: 0, used: 0 }
    }

    /// Ensures at least 32 bits, zeros after the end.
    fn fill(&mut self) {
        if self.held >= 32 {
            return;
        }
        let next = match self.bytes.get(self.at..self.at + 4) {
            Some(four) => u32::from_be_bytes([four[0], four[1], four[2], four[3]]),
            None => (0..4)
                .fold(0, |next, n| next << 8 | u32::from(self.bytes.get(self.at + n).copied().unwrap_or(0))),
        };
        self.hold |= u64::from(next) << (32 - self.held);
        self.held += 32;
        self.at += 4;
    }

    fn skip(&mut self, bits: u32) {
        self.hold <<= bits;
        self.held -= bits;
        self.used += bits as usize;
    }

    /// The next symbol; the bits of its value are skipped.
    fn symbol(&mut self, code: &Code) -> Option<u8> {
        self.fill();
        let (length, symbol) = code.next((self.hold >> 48) as u32)?;
        self.skip(length + u32::from(symbol & 15));
        Some(symbol)
    }

    /// The next difference of levels, of eight-bit pictures at most 11 bits (F.2.2.1).
    fn difference(&mut self, code: &Code) -> Option<i32> {
        self.fill();
        let (length, size) = code.next((self.hold >> 48) as u32).filter(|(_, size)| *size <= 11)?;
        self.skip(length);
        if size == 0 {
            return Some(0);
        }
        let value = (self.hold >> (64 - u32::from(size))) as i32;
        self.skip(u32::from(size));
        Some(if value < 1 << (size - 1) { value + 1 - (1 << size) } else { value })
    }

    /// Walks over a block and adds its difference to the level; returns whether it is a valid block.
    pub(super) fn block(&mut self, dc: &Code, ac: &Code, level: &mut i32) -> bool {
        let Some(difference) = self.difference(dc) else { return false };
        *level += difference;
        let mut place = 1;
        while place < 64 {
            match self.symbol(ac) {
                Some(0) => break,
                Some(0xF0) => place += 16,
                Some(symbol) if (1..=10).contains(&(symbol & 15)) => place += usize::from(symbol >> 4) + 1,
                _ => return false,
            }
            if place > 64 {
                return false;
            }
        }
        self.used <= 8 * self.bytes.len()
    }

    /// Whether only the padding of the last byte remains, and at most `zeros` bytes of zeros.
    pub(super) fn is_at_end(&self, zeros: usize) -> bool {
        let whole = self.used.div_ceil(8);
        let filling = self.bytes.get(self.used / 8).filter(|_| !self.used.is_multiple_of(8));
        let mask = 0xFFu8 >> (self.used % 8);
        let filled = filling.is_none_or(|byte| byte & mask == mask || byte & mask == 0);
        let rest = self.bytes.get(whole..).unwrap_or_default();
        filled && rest.len() <= zeros && rest.iter().all(|byte| *byte == 0)
    }
}

/// Writes codes in the form of a scan.
pub(super) struct Writer<'a> {
    out: &'a mut Vec<u8>,
    hold: u32,
    held: u32,
}

impl<'a> Writer<'a> {
    pub(super) const fn new(out: &'a mut Vec<u8>) -> Self {
        Self { out, hold: 0, held: 0 }
    }

    /// Appends a code: bits and their number, at most 16.
    pub(super) fn write(&mut self, (code, length): (u32, u32)) {
        self.hold = self.hold << length | code;
        self.held += length;
        while self.held >= 8 {
            self.held -= 8;
            let byte = (self.hold >> self.held) as u8;
            self.out.push(byte);
            if byte == 0xFF {
                self.out.push(0);
            }
        }
    }

    /// Pads the last byte with ones.
    pub(super) fn finish(mut self) {
        let spare = (8 - self.held % 8) % 8;
        self.write(((1 << spare) - 1, spare));
    }
}

/// The standard tables as a segment of a header: luminance and chrominance, differences and the rest.
pub(super) const STANDARD_TABLES: &[u8] = &standard_segment();

/// The standard tables: differences of luminance and chrominance, then the rest of both.
pub(super) fn standard() -> [Code; 4] {
    let code = |(counts, symbols): (&[u8; 16], &[u8])| {
        Code::new(counts, symbols).expect("the standard's tables are codes")
    };
    [
        code((&DC_LUMA, &DC_SYMBOLS)),
        code((&DC_CHROMA, &DC_SYMBOLS)),
        code((&AC_LUMA, &AC_LUMA_SYMBOLS)),
        code((&AC_CHROMA, &AC_CHROMA_SYMBOLS)),
    ]
}

const fn standard_segment() -> [u8; 420] {
    let mut segment = [0; 420];
    // Marker, and the length of the rest: 2 + 4 tables of 1 + 16 + symbols.
    (segment[0], segment[1], segment[2], segment[3]) = (0xFF, 0xC4, 1, 0xA2);
    let mut at = 4;
    let tables: [(u8, &[u8; 16], &[u8]); 4] = [
        (0x00, &DC_LUMA, &DC_SYMBOLS),
        (0x10, &AC_LUMA, &AC_LUMA_SYMBOLS),
        (0x01, &DC_CHROMA, &DC_SYMBOLS),
        (0x11, &AC_CHROMA, &AC_CHROMA_SYMBOLS),
    ];
    let mut table = 0;
    while table < 4 {
        let (class, counts, symbols) = tables[table];
        segment[at] = class;
        let mut n = 0;
        while n < 16 {
            segment[at + 1 + n] = counts[n];
            n += 1;
        }
        n = 0;
        while n < symbols.len() {
            segment[at + 17 + n] = symbols[n];
            n += 1;
        }
        at += 17 + symbols.len();
        table += 1;
    }
    segment
}

const DC_LUMA: [u8; 16] = [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0];
const DC_CHROMA: [u8; 16] = [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0];
const AC_LUMA: [u8; 16] = [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125];
const AC_CHROMA: [u8; 16] = [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119];
const DC_SYMBOLS: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
#[rustfmt::skip]
const AC_LUMA_SYMBOLS: [u8; 162] = [
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07,
    0x22, 0x71, 0x14, 0x32, 0x81, 0x91, 0xA1, 0x08, 0x23, 0x42, 0xB1, 0xC1, 0x15, 0x52, 0xD1, 0xF0,
    0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0A, 0x16, 0x17, 0x18, 0x19, 0x1A, 0x25, 0x26, 0x27, 0x28,
    0x29, 0x2A, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49,
    0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5A, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69,
    0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89,
    0x8A, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A, 0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7,
    0xA8, 0xA9, 0xAA, 0xB2, 0xB3, 0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA, 0xC2, 0xC3, 0xC4, 0xC5,
    0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2, 0xD3, 0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA, 0xE1, 0xE2,
    0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7, 0xF8,
    0xF9, 0xFA,
];
#[rustfmt::skip]
const AC_CHROMA_SYMBOLS: [u8; 162] = [
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71,
    0x13, 0x22, 0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xA1, 0xB1, 0xC1, 0x09, 0x23, 0x33, 0x52, 0xF0,
    0x15, 0x62, 0x72, 0xD1, 0x0A, 0x16, 0x24, 0x34, 0xE1, 0x25, 0xF1, 0x17, 0x18, 0x19, 0x1A, 0x26,
    0x27, 0x28, 0x29, 0x2A, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48,
    0x49, 0x4A, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5A, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68,
    0x69, 0x6A, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7A, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87,
    0x88, 0x89, 0x8A, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9A, 0xA2, 0xA3, 0xA4, 0xA5,
    0xA6, 0xA7, 0xA8, 0xA9, 0xAA, 0xB2, 0xB3, 0xB4, 0xB5, 0xB6, 0xB7, 0xB8, 0xB9, 0xBA, 0xC2, 0xC3,
    0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xCA, 0xD2, 0xD3, 0xD4, 0xD5, 0xD6, 0xD7, 0xD8, 0xD9, 0xDA,
    0xE2, 0xE3, 0xE4, 0xE5, 0xE6, 0xE7, 0xE8, 0xE9, 0xEA, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7, 0xF8,
    0xF9, 0xFA,
];
