//! How bytes are framed on a serial line.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Data bits, parity and stop bits in the usual notation: `8N1`, `7E1`.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Framing {
    /// Seven or eight.
    pub data_bits: u8,
    /// The parity bit.
    pub parity: Parity,
    /// One or two.
    pub stop_bits: u8,
}

/// The bit after the data bits.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Parity {
    /// Nothing.
    None,
    /// Even parity.
    Even,
    /// Odd parity.
    Odd,
}

impl Default for Framing {
    fn default() -> Self {
        Self { data_bits: 8, parity: Parity::None, stop_bits: 1 }
    }
}

impl Framing {
    /// Bits on the wire for a byte, including the start bit.
    ///
    /// ```
    /// use windhover_base::settings::Framing;
    ///
    /// let framing = Framing::try_from("7E2".to_owned()).expect("seven bits, even parity, two stop bits");
    /// assert_eq!(framing.bits(), 11);
    /// ```
    pub fn bits(self) -> u32 {
        1 + u32::from(self.data_bits) + u32::from(self.parity != Parity::None) + u32::from(self.stop_bits)
    }

    /// Whether it is the usual 8N1.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl TryFrom<String> for Framing {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let wrong = || format!("{text:?} is not like \"8N1\": 7 or 8 data bits, N, E or O, 1 or 2 stop bits");
        let [bits, parity, stop] = text.as_bytes() else { return Err(wrong()) };
        Ok(Self {
            data_bits: match bits {
                b'7' => 7,
                b'8' => 8,
                _ => return Err(wrong()),
            },
            parity: match parity {
                b'N' => Parity::None,
                b'E' => Parity::Even,
                b'O' => Parity::Odd,
                _ => return Err(wrong()),
            },
            stop_bits: match stop {
                b'1' => 1,
                b'2' => 2,
                _ => return Err(wrong()),
            },
        })
    }
}

impl From<Framing> for String {
    fn from(framing: Framing) -> Self {
        framing.to_string()
    }
}

impl fmt::Display for Framing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parity = match self.parity {
            Parity::None => 'N',
            Parity::Even => 'E',
            Parity::Odd => 'O',
        };
        write!(f, "{}{parity}{}", self.data_bits, self.stop_bits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_written_as_it_is_read() {
        for (text, bits) in [("8N1", 10), ("7E1", 10), ("8O2", 12), ("7N2", 10)] {
            let framing = Framing::try_from(text.to_owned()).expect(text);
            assert_eq!((framing.to_string().as_str(), framing.bits()), (text, bits));
        }
        for text in ["", "8N", "9N1", "8X1", "8N3", "8n1", "8N1 "] {
            assert!(Framing::try_from(text.to_owned()).is_err(), "{text:?}");
        }
    }
}
