//! MAT-files of level 5, as MATLAB 5 to 7.2 writes them (`-v6`, `-v7`): from bytes to values.
//!
//! A file is a header of 128 bytes and a row of elements, each a tag (type, length) and its data, padded to eight
//! bytes; one of type 15 is compressed (zlib) and holds another. Source: MATLAB, MAT-File Format (The MathWorks).
//!
//! Nothing is reserved on the word of the file: what is read is there, what is unpacked counts against [`ROOM`].

use crate::file::ROOM;
use crate::variables::{Array, Class, Value, Variable, rows_of};
use flate2::bufread::ZlibDecoder;
use std::io::Read;

/// Deepest nesting of structures and cells.
const MAX_DEPTH: usize = 32;

/// Bytes before the first element.
const HEADER: usize = 128;

/// Why the bytes are not read.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Fault {
    /// They are HDF5: a file of `-v7.3`.
    Hdf5,
    /// They are of another format: what it is, and the fix.
    Format(&'static str, &'static str),
    /// They end too early, or have no meaning: what was found, in which variable, before which byte.
    Damaged { variable: Option<String>, what: &'static str, at: usize },
    /// Unpacked they need more than [`ROOM`].
    TooLarge { variable: Option<String> },
}

/// The fix for formats that greybox does not read.
pub(super) const SAVE_V7: &str =
    "load it in MATLAB and write it again with `save('run.mat', 't', 'y', '-v7')`";

/// Reads all variables of a file.
pub(crate) fn variables(bytes: &[u8]) -> Result<Vec<Variable>, Fault> {
    variables_within(bytes, ROOM)
}

/// As [`variables`], where the values may need `room` bytes.
fn variables_within(bytes: &[u8], mut room: u64) -> Result<Vec<Variable>, Fault> {
    let big = check_header(bytes)?;
    let mut source = Source { bytes, at: HEADER, big, origin: 0 };
    let mut variables = Vec::new();
    while source.at < bytes.len() {
        let element = source.element()?;
        let variable = match element.kind {
            kind::COMPRESSED => {
                let inside = unpack(&element, &mut room)?;
                let mut inside = Source { bytes: &inside, at: 0, big, origin: element.at };
                let element = inside.element()?;
                matrix(&element, big, 0, &mut room)?
            }
            kind::MATRIX => matrix(&element, big, 0, &mut room)?,
            // Other elements hold no variable.
            _ => continue,
        };
        // MATLAB keeps the content of its objects in a variable without name.
        if !variable.name.is_empty() {
            variables.push(variable);
        }
    }
    Ok(variables)
}

/// Whether it is a file of `-v7.3`: HDF5, behind a header of MATLAB's or without.
pub(super) fn is_hdf5(bytes: &[u8]) -> bool {
    const HDF5: &[u8] = b"\x89HDF\r\n\x1a\n";
    bytes.starts_with(b"MATLAB 7.3 MAT-file") || bytes.starts_with(HDF5) || bytes.get(512..520) == Some(HDF5)
}

/// Whether the file has its high bytes first; an error where it is no file of level 5.
fn check_header(bytes: &[u8]) -> Result<bool, Fault> {
    if is_hdf5(bytes) {
        return Err(Fault::Hdf5);
    }
    let Some(header) = bytes.get(..HEADER) else {
        return Err(damaged("the file ends within its header", bytes.len()));
    };
    match (&header[126..128], header[..4].contains(&0)) {
        (_, true) => Err(Fault::Format("it is of version 4, or no MAT-file at all", SAVE_V7)),
        (b"IM", _) => Ok(false),
        (b"MI", _) => Ok(true),
        _ => Err(Fault::Format("it does not begin as a MAT-file does", SAVE_V7)),
    }
}

fn damaged(what: &'static str, at: usize) -> Fault {
    Fault::Damaged { variable: None, what, at }
}

/// Types of elements.
mod kind {
    pub(super) const INT8: u32 = 1;
    pub(super) const UINT8: u32 = 2;
    pub(super) const INT16: u32 = 3;
    pub(super) const UINT16: u32 = 4;
    pub(super) const INT32: u32 = 5;
    pub(super) const UINT32: u32 = 6;
    pub(super) const SINGLE: u32 = 7;
    pub(super) const DOUBLE: u32 = 9;
    pub(super) const INT64: u32 = 12;
    pub(super) const UINT64: u32 = 13;
    pub(super) const MATRIX: u32 = 14;
    pub(super) const COMPRESSED: u32 = 15;
    pub(super) const UTF16: u32 = 17;
    pub(super) const UTF32: u32 = 18;
}

/// Bytes that are read from front to back.
struct Source<'a> {
    bytes: &'a [u8],
    at: usize,
    big: bool,
    /// Where they stand in the file, for errors.
    origin: usize,
}

/// An element: its type and data.
struct Element<'a> {
    kind: u32,
    data: &'a [u8],
    /// Where the data stand in the file.
    at: usize,
}

impl<'a> Source<'a> {
    fn here(&self) -> usize {
        self.origin + self.at
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], Fault> {
        let rest = &self.bytes[self.at..];
        let taken = rest.get(..length).ok_or_else(|| {
            damaged(
                "a variable claims more than the file holds, which ends too early",
                self.origin + self.bytes.len(),
            )
        })?;
        self.at += length;
        Ok(taken)
    }

    fn number(&mut self) -> Result<u32, Fault> {
        let four = self.take(4)?;
        let four: [u8; 4] = std::array::from_fn(|k| four[k]);
        Ok(if self.big { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) })
    }

    /// The next element and the padding behind it.
    fn element(&mut self) -> Result<Element<'a>, Fault> {
        let first = self.number()?;
        // Up to four bytes stand in the tag itself, whose upper half says how many.
        if first >> 16 != 0 {
            let length = (first >> 16) as usize;
            let at = self.here();
            let data =
                self.take(4)?.get(..length).ok_or_else(|| damaged("a short element is too long", at))?;
            return Ok(Element { kind: first & 0xffff, data, at });
        }
        let length = self.number()? as usize;
        let at = self.here();
        let data = self.take(length)?;
        if first != kind::COMPRESSED {
            let padding = length.next_multiple_of(8) - length;
            self.at = (self.at + padding).min(self.bytes.len());
        }
        Ok(Element { kind: first, data, at })
    }
}

/// The bytes in a compressed element.
fn unpack(element: &Element<'_>, room: &mut u64) -> Result<Vec<u8>, Fault> {
    let mut inside = Vec::new();
    let read = ZlibDecoder::new(element.data).take(*room + 1).read_to_end(&mut inside);
    if inside.len() as u64 > *room {
        return Err(Fault::TooLarge { variable: None });
    }
    *room -= inside.len() as u64;
    match read {
        Ok(_) => Ok(inside),
        Err(_) => Err(damaged("what is compressed there cannot be unpacked", element.at)),
    }
}

/// Reads a variable, a field or a cell.
fn matrix(element: &Element<'_>, big: bool, depth: usize, room: &mut u64) -> Result<Variable, Fault> {
    let nothing = Array { dimensions: vec![0, 0], values: Vec::new(), class: Class::Double };
    if element.kind != kind::MATRIX {
        return Err(damaged("there is something else than an array", element.at));
    }
    if element.data.is_empty() {
        return Ok(Variable { name: String::new(), value: Value::Numbers(nothing) });
    }
    if depth > MAX_DEPTH {
        return Err(damaged("structures are nested too deeply", element.at));
    }
    let mut source = Source { bytes: element.data, at: 0, big, origin: element.at };
    let mut flags = Source { at: 0, origin: source.origin, big, bytes: source.element()?.data };
    let flags = flags.number()?;
    // Objects of newer classes have no dimensions.
    let dimensions =
        if flags & 0xff == class::OPAQUE { Vec::new() } else { dimensions(&source.element()?, big)? };
    let name = text_of(&source.element()?, big);
    let content = content(&mut source, flags, dimensions, depth, room);
    let value = content.map_err(|fault| match fault {
        Fault::Damaged { variable: None, what, at } if depth == 0 => {
            Fault::Damaged { variable: Some(name.clone()), what, at }
        }
        Fault::TooLarge { variable: None } if depth == 0 => Fault::TooLarge { variable: Some(name.clone()) },
        other => other,
    })?;
    Ok(Variable { name, value })
}

/// Classes of arrays.
mod class {
    pub(super) const CELL: u32 = 1;
    pub(super) const STRUCTURE: u32 = 2;
    pub(super) const OBJECT: u32 = 3;
    pub(super) const TEXT: u32 = 4;
    pub(super) const SPARSE: u32 = 5;
    pub(super) const DOUBLE: u32 = 6;
    pub(super) const SINGLE: u32 = 7;
    pub(super) const UINT64: u32 = 15;
    pub(super) const FUNCTION: u32 = 16;
    pub(super) const OPAQUE: u32 = 17;
}

/// What stands behind flags, dimensions and name.
fn content(
    source: &mut Source<'_>,
    flags: u32,
    dimensions: Vec<usize>,
    depth: usize,
    room: &mut u64,
) -> Result<Value, Fault> {
    let big = source.big;
    let (class, complex, logical) = (flags & 0xff, flags & 0x800 != 0, flags & 0x200 != 0);
    let count = dimensions.iter().try_fold(1usize, |product, &d| product.checked_mul(d));
    let count = count.ok_or_else(|| damaged("its dimensions are too large", source.here()))?;
    match class {
        class::CELL => {
            let mut cells = Vec::new();
            for _ in 0..count {
                cells.push(matrix(&source.element()?, big, depth + 1, room)?.value);
            }
            Ok(Value::Cells(cells))
        }
        class::STRUCTURE => structure(source, count, depth, room),
        class::TEXT => {
            let element = source.element()?;
            let rows = dimensions.first().copied().unwrap_or(0);
            Ok(Value::Text(rows_of(&text_of(&element, big), rows, count)))
        }
        class::DOUBLE..=class::UINT64 if complex => Ok(Value::Other("complex numbers")),
        class::DOUBLE..=class::UINT64 => {
            let element = source.element()?;
            let values = numbers(&element, big, count, room)?;
            let class = match class {
                _ if logical => Class::Truth,
                class::SINGLE => Class::Single,
                _ => Class::Double,
            };
            Ok(Value::Numbers(Array { dimensions, values, class }))
        }
        class::SPARSE => Ok(Value::Other("a sparse matrix")),
        class::FUNCTION => Ok(Value::Other("a function")),
        class::OBJECT | class::OPAQUE => Ok(Value::Other("an object")),
        _ => Err(damaged("it is of no known class", source.here())),
    }
}

fn dimensions(element: &Element<'_>, big: bool) -> Result<Vec<usize>, Fault> {
    let wrong = || damaged("its dimensions cannot be read", element.at);
    let mut source = Source { bytes: element.data, at: 0, big, origin: element.at };
    let mut dimensions = Vec::new();
    while source.at < element.data.len() {
        dimensions.push(usize::try_from(source.number()?.cast_signed()).map_err(|_| wrong())?);
    }
    if dimensions.len() < 2 || dimensions.len() > MAX_DEPTH { Err(wrong()) } else { Ok(dimensions) }
}

/// `count` structures: the length of a field's name, all names, then structure by structure the fields' values.
fn structure(source: &mut Source<'_>, count: usize, depth: usize, room: &mut u64) -> Result<Value, Fault> {
    let big = source.big;
    let length = source.element()?;
    let mut length = Source { bytes: length.data, at: 0, big, origin: length.at };
    let length = length.number()? as usize;
    let names = source.element()?;
    if length == 0 || names.data.len() % length != 0 {
        return Err(damaged("the names of its fields cannot be read", names.at));
    }
    let name = |bytes: &[u8]| {
        let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
        String::from_utf8_lossy(&bytes[..end]).into_owned()
    };
    let mut fields: Vec<(String, Vec<Value>)> =
        names.data.chunks(length).map(|bytes| (name(bytes), Vec::new())).collect();
    if fields.is_empty() {
        return Ok(Value::Structure { count, fields });
    }
    for _ in 0..count {
        for (_, values) in &mut fields {
            values.push(matrix(&source.element()?, big, depth + 1, room)?.value);
        }
    }
    Ok(Value::Structure { count, fields })
}

/// The numbers of an element, of which there must be `count`.
fn numbers(element: &Element<'_>, big: bool, count: usize, room: &mut u64) -> Result<Vec<f64>, Fault> {
    macro_rules! read {
        ($number:ty) => {{
            let one = |bytes: &[u8]| {
                let bytes = std::array::from_fn(|k| bytes[k]);
                (if big { <$number>::from_be_bytes(bytes) } else { <$number>::from_le_bytes(bytes) }) as f64
            };
            (size_of::<$number>(), Box::new(one) as Box<dyn Fn(&[u8]) -> f64>)
        }};
    }
    let (size, one) = match element.kind {
        kind::INT8 => read!(i8),
        kind::UINT8 => read!(u8),
        kind::INT16 => read!(i16),
        kind::UINT16 => read!(u16),
        kind::INT32 => read!(i32),
        kind::UINT32 => read!(u32),
        kind::SINGLE => read!(f32),
        kind::DOUBLE => read!(f64),
        kind::INT64 => read!(i64),
        kind::UINT64 => read!(u64),
        _ => return Err(damaged("its numbers are of no known type", element.at)),
    };
    if count.checked_mul(size) != Some(element.data.len()) {
        return Err(damaged("it has not as many numbers as its dimensions say", element.at));
    }
    // In memory they are doubles, whatever they are in the file.
    let needed = 8 * count as u64;
    *room = room.checked_sub(needed).ok_or(Fault::TooLarge { variable: None })?;
    Ok(element.data.chunks_exact(size).map(one).collect())
}

/// The text of an element.
fn text_of(element: &Element<'_>, big: bool) -> String {
    let wide = |bytes: &[u8]| {
        let two = [bytes[0], bytes[1]];
        if big { u16::from_be_bytes(two) } else { u16::from_le_bytes(two) }
    };
    let long = |bytes: &[u8]| {
        let four = [bytes[0], bytes[1], bytes[2], bytes[3]];
        if big { u32::from_be_bytes(four) } else { u32::from_le_bytes(four) }
    };
    match element.kind {
        kind::UINT16 | kind::UTF16 => {
            let units: Vec<u16> = element.data.chunks_exact(2).map(wide).collect();
            String::from_utf16_lossy(&units)
        }
        kind::UTF32 => {
            let unknown = char::REPLACEMENT_CHARACTER;
            element.data.chunks_exact(4).map(|b| char::from_u32(long(b)).unwrap_or(unknown)).collect()
        }
        _ => String::from_utf8_lossy(element.data).into_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with these elements (type, data), numbers with their high bytes first where `big`.
    fn file(big: bool, elements: &[(u32, &[u8])]) -> Vec<u8> {
        let mut bytes = b"MATLAB 5.0 MAT-file".to_vec();
        bytes.resize(124, b' ');
        bytes.extend(if big { *b"\x01\x00MI" } else { *b"\x00\x01IM" });
        for element in elements {
            bytes.extend(packed(big, element));
        }
        bytes
    }

    fn word(big: bool, number: u32) -> [u8; 4] {
        if big { number.to_be_bytes() } else { number.to_le_bytes() }
    }

    fn packed(big: bool, (kind, data): &(u32, &[u8])) -> Vec<u8> {
        let length = u32::try_from(data.len()).unwrap();
        let mut bytes = [word(big, *kind), word(big, length)].concat();
        bytes.extend(*data);
        if *kind != kind::COMPRESSED {
            bytes.resize(bytes.len().next_multiple_of(8), 0);
        }
        bytes
    }

    /// The data of an array `name` of this class; `rest` stands behind its name.
    fn array(big: bool, class: u32, dimensions: &[u32], name: &str, rest: &[u8]) -> Vec<u8> {
        let flags = [word(big, class), word(big, 0)].concat();
        let dimensions: Vec<u8> = dimensions.iter().flat_map(|&d| word(big, d)).collect();
        let mut bytes = packed(big, &(kind::UINT32, &flags));
        bytes.extend(packed(big, &(kind::INT32, &dimensions)));
        bytes.extend(packed(big, &(kind::INT8, name.as_bytes())));
        bytes.extend(rest);
        bytes
    }

    fn zipped(bytes: &[u8]) -> Vec<u8> {
        let mut zipped = Vec::new();
        flate2::bufread::ZlibEncoder::new(bytes, flate2::Compression::best())
            .read_to_end(&mut zipped)
            .unwrap();
        zipped
    }

    #[test]
    fn both_byte_orders_are_read() {
        for big in [false, true] {
            let numbers: Vec<u8> = [1.5f64, -2.0]
                .iter()
                .flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() })
                .collect();
            let x = array(big, class::DOUBLE, &[1, 2], "x", &packed(big, &(kind::DOUBLE, &numbers)));
            let read = variables(&file(big, &[(kind::MATRIX, &x)])).unwrap();
            let array = Array { dimensions: vec![1, 2], values: vec![1.5, -2.0], class: Class::Double };
            assert_eq!(read, [Variable { name: "x".into(), value: Value::Numbers(array) }]);
        }
    }

    /// Sizes that the file claims and does not have: no memory is reserved and no time spent for them.
    #[test]
    fn what_is_claimed_and_not_there_is_an_error() {
        let huge = [0x7fff_ffff, 0x7fff_ffff];
        let none: Vec<u8> = packed(false, &(kind::DOUBLE, &[]));
        let fieldless =
            [packed(false, &(kind::INT32, &[8, 0, 0, 0])), packed(false, &(kind::INT8, &[]))].concat();
        for (class, rest, damaged) in [
            (class::DOUBLE, &none, true),
            (class::CELL, &none, true),
            (class::STRUCTURE, &fieldless, false),
            (class::TEXT, &none, false),
        ] {
            let x = array(false, class, &huge, "x", rest);
            let read = variables(&file(false, &[(kind::MATRIX, &x)]));
            assert_eq!(read.is_err(), damaged, "{class}: {read:?}");
        }
        let x = array(false, class::DOUBLE, &[0x7fff_ffff; 4], "x", &none);
        let read = variables(&file(false, &[(kind::MATRIX, &x)]));
        assert!(matches!(read, Err(Fault::Damaged { variable: Some(ref x), .. }) if x == "x"), "{read:?}");
    }

    #[test]
    fn what_is_unpacked_is_counted() {
        let zeros = vec![0; 100_000];
        let x = array(false, class::DOUBLE, &[100_000, 1], "x", &packed(false, &(kind::UINT8, &zeros)));
        let packed = zipped(&packed(false, &(kind::MATRIX, &x)));
        let bytes = file(false, &[(kind::COMPRESSED, &packed)]);
        assert!(bytes.len() < 1000);
        // Unpacked, 100 000 bytes and their tags; as numbers in memory, eight times as many.
        assert_eq!(variables_within(&bytes, 50_000), Err(Fault::TooLarge { variable: None }));
        assert_eq!(variables_within(&bytes, 500_000), Err(Fault::TooLarge { variable: Some("x".into()) }));
        assert!(variables_within(&bytes, 1_000_000).is_ok());
    }

    #[test]
    fn cells_may_not_hold_each_other_without_end() {
        let mut cell = Vec::new();
        for _ in 0..1000 {
            cell = array(false, class::CELL, &[1, 1], "", &packed(false, &(kind::MATRIX, &cell)));
        }
        let read = variables(&file(false, &[(kind::MATRIX, &cell)]));
        assert!(matches!(read, Err(Fault::Damaged { .. })), "{read:?}");
    }
}
