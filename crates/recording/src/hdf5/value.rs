//! What a data set holds: its kind, and how its numbers are written.

use crate::number::{Kind, Number};
use ::hdf5_pure::{Datatype, DatatypeByteOrder, FixedPointLayout, FloatingPointLayout};

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

/// How the numbers of this type are read; `None` for what is no number, or one of an unusual form.
pub(super) fn number(datatype: &Datatype) -> Option<Number> {
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
        Datatype::Enumeration { base_type, members, .. } => {
            let mut names: Vec<&str> = members.iter().map(|member| member.name.as_str()).collect();
            names.sort_unstable();
            let number = number(base_type)?;
            Some(if names == ["FALSE", "TRUE"] { Number { kind: Kind::Truth, ..number } } else { number })
        }
        _ => None,
    }
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
