//! Numbers as files hold them: their kind, size and byte order.

use crate::variables::Class;

/// How a number is written.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Number {
    pub(crate) kind: Kind,
    pub(crate) size: usize,
    /// Whether the high bytes stand first.
    pub(crate) big: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Kind {
    Signed,
    Unsigned,
    Float,
    /// Truth values: 0 and 1.
    Truth,
}

impl Number {
    pub(crate) fn class(self) -> Class {
        match (self.kind, self.size) {
            (Kind::Truth, _) => Class::Truth,
            (Kind::Float, 0..8) => Class::Single,
            _ => Class::Double,
        }
    }

    /// Whether it is a unit of UTF-16, as of MATLAB's texts.
    #[cfg(feature = "hdf5")]
    pub(crate) fn is_text_unit(self) -> bool {
        self.kind == Kind::Unsigned && self.size == 2
    }

    /// The numbers at `offset` of every record of `stride` bytes.
    pub(crate) fn read(self, bytes: &[u8], offset: usize, stride: usize) -> Vec<f64> {
        let records = bytes.chunks_exact(stride.max(1));
        records
            .map(|record| {
                record.get(offset..offset.saturating_add(self.size)).map_or(f64::NAN, |b| self.one(b))
            })
            .collect()
    }

    /// As [`read`](Self::read), for units of UTF-16.
    #[cfg(feature = "hdf5")]
    pub(crate) fn text(self, bytes: &[u8]) -> String {
        let units: Vec<u16> = bytes.chunks_exact(2).map(|two| self.raw(two) as u16).collect();
        String::from_utf16_lossy(&units)
    }

    /// The bits, low ones first.
    fn raw(self, bytes: &[u8]) -> u64 {
        let shifted = |(k, &byte): (usize, &u8)| u64::from(byte) << (8 * k);
        match self.big {
            true => bytes.iter().rev().enumerate().map(shifted).sum(),
            false => bytes.iter().enumerate().map(shifted).sum(),
        }
    }

    fn one(self, bytes: &[u8]) -> f64 {
        let raw = self.raw(bytes);
        match (self.kind, self.size) {
            (Kind::Unsigned | Kind::Truth, _) => raw as f64,
            (Kind::Signed, size) => {
                let unused = 64 - 8 * size as u32;
                ((raw << unused).cast_signed() >> unused) as f64
            }
            (Kind::Float, 2) => half(raw),
            (Kind::Float, 4) => f64::from(f32::from_bits(raw as u32)),
            (Kind::Float, _) => f64::from_bits(raw),
        }
    }
}

/// The number with these 16 bits: a sign, five bits of the exponent, ten of the fraction.
fn half(bits: u64) -> f64 {
    let fraction = (bits & 0x3ff) as f64 / 1024.0;
    let size = match bits >> 10 & 0x1f {
        0 => fraction / f64::from(1 << 14),
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        exponent => (1.0 + fraction) * f64::from(1u32 << exponent) / f64::from(1 << 15),
    };
    if bits >> 15 & 1 == 1 { -size } else { size }
}
