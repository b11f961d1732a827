//! An array of NumPy: its head and its values. Source: NumPy, `numpy.lib.format`.
//!
//! Nothing is reserved on the word of the file: what is read is there, and counts against the room.

use super::Fault;
use super::literal::Literal;
use crate::number::{Kind, Number};
use crate::variables::{Array, Value};

const MAGIC: &[u8] = b"\x93NUMPY";

const HEAD: Fault = Fault::Damaged("its head cannot be read");

/// Whether the bytes begin as an array does.
pub(super) fn is_array(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

/// What the array in `bytes` holds.
pub(super) fn value(bytes: &[u8], room: &mut u64) -> Result<Value, Fault> {
    let (head, data) = head(bytes)?;
    let by_columns = matches!(head.get("fortran_order"), Some(Literal::Truth(true)));
    let Some(Literal::List(shape)) = head.get("shape") else { return Err(HEAD) };
    let shape: Option<Vec<usize>> = shape.iter().map(size).collect();
    let shape = shape.ok_or(HEAD)?;
    let count = shape.iter().try_fold(1usize, |count, &d| count.checked_mul(d)).ok_or(HEAD)?;
    let mut array = Data { data, count, shape, by_columns, room };
    match head.get("descr").ok_or(HEAD)? {
        Literal::Text(kind) => array.values(&Kinds::of(kind), 0, None),
        Literal::List(fields) => array.records(fields),
        _ => Err(HEAD),
    }
}

/// The head of an array, and the bytes behind it.
fn head(bytes: &[u8]) -> Result<(Literal, &[u8]), Fault> {
    let rest = bytes.get(MAGIC.len()..).ok_or(HEAD)?;
    let (version, rest) = rest.split_at_checked(2).ok_or(HEAD)?;
    let (length, rest) = rest.split_at_checked(if version[0] == 1 { 2 } else { 4 }).ok_or(HEAD)?;
    let length = length.iter().rev().fold(0usize, |number, &byte| number << 8 | usize::from(byte));
    let (head, data) = rest.split_at_checked(length).ok_or(HEAD)?;
    let head = std::str::from_utf8(head).ok().and_then(Literal::parse).ok_or(HEAD)?;
    Ok((head, data))
}

fn size(literal: &Literal) -> Option<usize> {
    match literal {
        Literal::Number(number) => usize::try_from(*number).ok(),
        _ => None,
    }
}

/// What an element is.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kinds {
    Number(Number),
    /// A text of so many characters, each of so many bytes.
    Text {
        length: usize,
        wide: bool,
        big: bool,
    },
    /// Something that is not read: what it is, and its bytes where they are known.
    Other(&'static str, Option<usize>),
}

impl Kinds {
    /// That of a description such as `<f8`: byte order, letter, number of bytes or characters.
    fn of(text: &str) -> Kinds {
        let unknown = Kinds::Other("no numbers", None);
        let (big, rest) = match text.as_bytes().first() {
            Some(b'<' | b'|' | b'=') => (false, &text[1..]),
            Some(b'>') => (true, &text[1..]),
            _ => (false, text),
        };
        let Some(letter) = rest.chars().next() else { return unknown };
        let digits = rest[letter.len_utf8()..].trim_end_matches(|c: char| !c.is_ascii_digit());
        let size: usize = digits.split('[').next().and_then(|size| size.parse().ok()).unwrap_or(0);
        let kind = match (letter, size) {
            ('f', 2 | 4 | 8) => Kind::Float,
            ('i', 1 | 2 | 4 | 8) => Kind::Signed,
            ('u', 1 | 2 | 4 | 8) => Kind::Unsigned,
            ('b', 1) => Kind::Truth,
            ('U', length) => return Kinds::Text { length, wide: true, big },
            ('S', length) => return Kinds::Text { length, wide: false, big },
            ('c', size) => return Kinds::Other("complex numbers", Some(size)),
            ('O', _) => return Kinds::Other("Python objects", None),
            ('M' | 'm', size) => return Kinds::Other("dates or durations", Some(size)),
            ('f', size) => return Kinds::Other("numbers of an unusual form", Some(size)),
            ('V', size) => return Kinds::Other("raw bytes", Some(size)),
            _ => return unknown,
        };
        Kinds::Number(Number { kind, size, big })
    }

    /// How many bytes it takes.
    fn bytes(self) -> Option<usize> {
        match self {
            Kinds::Number(number) => Some(number.size),
            Kinds::Text { length, wide, .. } => length.checked_mul(if wide { 4 } else { 1 }),
            Kinds::Other(_, bytes) => bytes,
        }
    }
}

/// The bytes of an array and how they lie.
struct Data<'a> {
    data: &'a [u8],
    count: usize,
    shape: Vec<usize>,
    by_columns: bool,
    room: &'a mut u64,
}

impl Data<'_> {
    /// The values of a kind that stand `offset` bytes behind the start of every record of `stride` bytes.
    fn values(&mut self, kind: &Kinds, offset: usize, stride: Option<usize>) -> Result<Value, Fault> {
        const SHORT: Fault = Fault::Damaged("it has not as many values as its shape says");
        if let Kinds::Other(what, _) = kind {
            return Ok(Value::Other(what));
        }
        let stride = stride.or(kind.bytes()).ok_or(HEAD)?;
        if self.count.checked_mul(stride).is_none_or(|needed| needed > self.data.len()) {
            return Err(SHORT);
        }
        // Texts without characters take no bytes: none are made of them.
        if stride == 0 {
            return Ok(Value::Text(Vec::new()));
        }
        let data = &self.data[..self.count * stride];
        *self.room = self.room.checked_sub(8 * self.count as u64).ok_or(Fault::TooLarge)?;
        Ok(match *kind {
            Kinds::Number(number) => {
                let values = number.read(data, offset, stride);
                Value::Numbers(match self.by_columns && self.shape.len() > 1 {
                    true => Array { dimensions: self.shape.clone(), values, class: number.class() },
                    false => Array::by_rows(&self.shape, values, number.class()),
                })
            }
            Kinds::Text { wide, big, .. } => {
                let length = kind.bytes().ok_or(HEAD)?;
                let texts = data.chunks_exact(stride).map(|record| {
                    let bytes = record.get(offset..offset + length).unwrap_or_default();
                    text(bytes, wide, big)
                });
                Value::Text(texts.collect())
            }
            Kinds::Other(what, _) => Value::Other(what),
        })
    }

    /// Each field of the records as an array of its own.
    fn records(&mut self, fields: &[Literal]) -> Result<Value, Fault> {
        let mut kinds = Vec::new();
        let mut stride = 0usize;
        for field in fields {
            let Literal::List(field) = field else { return Err(HEAD) };
            let (name, kind) = match field.as_slice() {
                [Literal::Text(name), Literal::Text(kind)] => (name, Kinds::of(kind)),
                // A title stands beside the name.
                [Literal::List(names), Literal::Text(kind)] => match names.last() {
                    Some(Literal::Text(name)) => (name, Kinds::of(kind)),
                    _ => return Err(HEAD),
                },
                [Literal::Text(_), ..] => return Ok(Value::Other("records within records")),
                _ => return Err(HEAD),
            };
            let Some(bytes) = kind.bytes() else { return Ok(Value::Other("records with Python objects")) };
            kinds.push((name, kind, stride));
            stride = stride.checked_add(bytes).ok_or(HEAD)?;
        }
        let mut values = Vec::new();
        for (name, kind, offset) in kinds {
            // What only fills a gap has no name.
            if !name.is_empty() {
                values.push((name.clone(), vec![self.values(&kind, offset, Some(stride))?]));
            }
        }
        Ok(Value::Structure { count: 1, fields: values })
    }
}

/// A text, which ends with its last character that is not zero.
fn text(bytes: &[u8], wide: bool, big: bool) -> String {
    let text = match wide {
        true => {
            let code = |four: &[u8]| {
                let four = [four[0], four[1], four[2], four[3]];
                let code = if big { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) };
                char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER)
            };
            bytes.chunks_exact(4).map(code).collect()
        }
        false => String::from_utf8_lossy(bytes).into_owned(),
    };
    text.trim_end_matches('\0').to_owned()
}
