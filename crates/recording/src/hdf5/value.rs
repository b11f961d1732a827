//! What a data set holds: its kind, and its numbers from their bytes.

use ::hdf5_pure::{Datatype, DatatypeByteOrder, FixedPointLayout, FloatingPointLayout};

/// Numbers of a data set, or of a field of its records.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Number {
    kind: Kind,
    size: usize,
    big: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Signed,
    Unsigned,
    Float,
}

/// Sizes and layouts of the floating-point numbers of IEEE 754 that are read: half, single and double.
const IEEE: [(u32, FloatingPointLayout); 3] = [
    (
        2,
        FloatingPointLayout {
            bit_offset: 0,
            bit_precision: 16,
            exponent_location: 10,
            exponent_size: 5,
            mantissa_location: 0,
            mantissa_size: 10,
            exponent_bias: 15,
        },
    ),
    (4, FloatingPointLayout::IEEE754_BINARY32),
    (8, FloatingPointLayout::IEEE754_BINARY64),
];

impl Number {
    /// How the numbers of this type are read; `None` for what is no number, or one of an unusual form.
    pub(super) fn of(datatype: &Datatype) -> Option<Number> {
        let big = |order: &DatatypeByteOrder| match order {
            DatatypeByteOrder::LittleEndian => Some(false),
            DatatypeByteOrder::BigEndian => Some(true),
            _ => None,
        };
        match datatype {
            Datatype::FixedPoint {
                size,
                byte_order,
                layout: FixedPointLayout { signed, bit_offset: 0, bit_precision, .. },
            } if matches!(size, 1 | 2 | 4 | 8) && u32::from(*bit_precision) == 8 * size => {
                let kind = if *signed { Kind::Signed } else { Kind::Unsigned };
                Some(Number { kind, size: *size as usize, big: big(byte_order)? })
            }
            Datatype::FloatingPoint { size, byte_order, layout } if IEEE.contains(&(*size, *layout)) => {
                Some(Number { kind: Kind::Float, size: *size as usize, big: big(byte_order)? })
            }
            Datatype::Enumeration { base_type, .. } => Number::of(base_type),
            _ => None,
        }
    }

    /// Whether digits end after seven or earlier.
    pub(super) fn is_single(self) -> bool {
        self.kind == Kind::Float && self.size < 8
    }

    /// Whether it is a unit of UTF-16, as of MATLAB's texts.
    pub(super) fn is_text_unit(self) -> bool {
        self.kind == Kind::Unsigned && self.size == 2
    }

    /// The numbers at `offset` of every record of `stride` bytes.
    pub(super) fn read(self, bytes: &[u8], offset: usize, stride: usize) -> Vec<f64> {
        let records = bytes.chunks_exact(stride.max(1));
        records
            .map(|record| record.get(offset..offset + self.size).map_or(f64::NAN, |b| self.one(b)))
            .collect()
    }

    /// As [`read`](Self::read), for units of UTF-16.
    pub(super) fn text(self, bytes: &[u8]) -> String {
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
            (Kind::Unsigned, _) => raw as f64,
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

/// What is no number, in words.
pub(super) fn described(datatype: &Datatype) -> &'static str {
    match datatype {
        Datatype::Compound { members, .. } => {
            let names: Vec<&str> = members.iter().map(|m| m.name.as_str()).collect();
            if matches!(names.as_slice(), ["real", "imag"] | ["r", "i"]) {
                "complex numbers"
            } else {
                "records"
            }
        }
        Datatype::String { .. } | Datatype::VariableLength { is_string: true, .. } => "texts",
        Datatype::VariableLength { .. } => "lists of different lengths",
        Datatype::Reference { .. } => "references",
        Datatype::Array { .. } => "arrays in each element",
        Datatype::FixedPoint { .. } | Datatype::FloatingPoint { .. } => "numbers of an unusual form",
        _ => "no numbers",
    }
}
