//! The numbers of a message, one after the other, and what they are called.
//!
//! A number is called `/topic.field.path`. In an array it gets a bracket: the name of its joint where the message has, in
//! the same structure or in one around it, a list of as many different names (`name`, `names`, or `…_names`), else its
//! number, `[0]`. Arrays of bytes, and of more than [`MOST`] values, are left out.

use super::cdr::{Bytes, Fault};
use super::schema::{Count, Kind, Message, Primitive, Types};
use super::units;
use std::collections::{BTreeMap, BTreeSet};

/// Most values of an array that become series: more than a machine has axes, fewer than a scan or an image has points.
pub(super) const MOST: usize = 64;

/// Deepest nesting of the structures of a message.
const DEEPEST: usize = 32;

/// What is called and measured how.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Column {
    pub(super) name: String,
    pub(super) unit: Option<&'static str>,
    /// A truth value keeps its value between samples.
    pub(super) held: bool,
}

/// The numbers of a message.
#[derive(Debug, Clone, Default)]
pub(super) struct Row {
    pub(super) numbers: Vec<f64>,
    /// Lengths and names in the message: numbers of messages of one shape have the same names.
    pub(super) shape: Vec<u8>,
    /// Stamp of the header, ns.
    pub(super) stamp: Option<i64>,
}

/// Whether a list of texts called so names the values beside it.
pub(super) fn is_names(field: &str) -> bool {
    matches!(field, "name" | "names") || field.ends_with("_names")
}

/// The bracket of value `index` of `count`, by the innermost names that fit.
pub(super) fn bracket(names: &[Vec<String>], index: usize, count: usize) -> String {
    let fit = |names: &&Vec<String>| {
        names.len() == count && names.iter().collect::<BTreeSet<_>>().len() == count && !names[0].is_empty()
    };
    match names.iter().rev().find(fit) {
        Some(names) => format!("[{}]", names[index]),
        None => format!("[{index}]"),
    }
}

/// Reads the numbers of a message.
///
/// # Errors
/// Bytes that are no such message, in words.
pub(super) fn numbers(types: &Types, bytes: Bytes<'_>) -> Result<Row, Fault> {
    let mut walk = Walk { types, row: Row::default(), muted: false, naming: None };
    walk.whole(bytes)?;
    Ok(walk.row)
}

/// The names of the numbers of a message of `topic`, and of what is left out of it, with the reason.
///
/// # Errors
/// As [`numbers`].
pub(super) fn columns(
    types: &Types,
    bytes: Bytes<'_>,
    topic: &str,
) -> Result<(Vec<Column>, BTreeMap<String, String>), Fault> {
    let naming = Naming { path: topic.to_owned(), ..Naming::default() };
    let mut walk = Walk { types, row: Row::default(), muted: false, naming: Some(naming) };
    walk.whole(bytes)?;
    let Naming { columns, left_out, .. } = walk.naming.unwrap_or_default();
    Ok((columns, left_out))
}

/// What names are made from.
#[derive(Default)]
struct Naming {
    path: String,
    /// Lists of names, those of the innermost structure last.
    names: Vec<Vec<String>>,
    columns: Vec<Column>,
    left_out: BTreeMap<String, String>,
}

struct Walk<'a> {
    types: &'a Types,
    row: Row,
    /// Within something that is left out.
    muted: bool,
    naming: Option<Naming>,
}

impl<'a> Walk<'a> {
    fn whole(&mut self, mut bytes: Bytes<'_>) -> Result<(), Fault> {
        self.message(0, &mut bytes, None, 0)
    }

    fn message(
        &mut self,
        place: usize,
        bytes: &mut Bytes<'_>,
        unit: Option<&'static str>,
        depth: usize,
    ) -> Result<(), Fault> {
        bytes.step()?;
        let types: &'a Types = self.types;
        let (Some(message), true) = (types.0.get(place), depth <= DEEPEST) else {
            return Err(format!("its types are nested more than {DEEPEST} deep"));
        };
        if message.fields.is_empty() && bytes.is_cdr() {
            // A structure without a member has one in CDR.
            bytes.skip(Primitive::U8, 1)?;
        }
        let names = match self.naming {
            Some(_) => self.names(message, bytes.clone(), depth)?,
            None => Vec::new(),
        };
        let known = self.naming.as_mut().map_or(0, |naming| {
            naming.names.extend(names);
            naming.names.len()
        });
        for (k, field) in message.fields.iter().enumerate() {
            if types.is_header(&field.kind) && field.count == Count::One {
                let stamp = header(bytes)?;
                if depth == 0 && k == 0 {
                    self.row.stamp = Some(stamp);
                }
                continue;
            }
            let length = self.naming.as_ref().map_or(0, |naming| naming.path.len());
            if let Some(naming) = &mut self.naming {
                naming.path.push('.');
                naming.path.push_str(&field.name);
            }
            let unit = units::of(&message.name, &field.name).or(unit);
            match field.count {
                Count::One => self.one(&field.kind, bytes, unit, depth)?,
                Count::Fixed(n) => self.several(&field.name, &field.kind, n, bytes, unit, depth)?,
                Count::Sequence => {
                    let n = bytes.length()?;
                    self.several(&field.name, &field.kind, n, bytes, unit, depth)?;
                }
            }
            if let Some(naming) = &mut self.naming {
                naming.path.truncate(length);
            }
        }
        if let Some(naming) = &mut self.naming {
            let own = message.fields.iter().filter(|f| lists_names(f)).count().min(known);
            naming.names.truncate(known - own);
        }
        Ok(())
    }

    /// The lists of names among the fields of a message, wherever they stand in it.
    fn names(
        &self,
        message: &Message,
        mut bytes: Bytes<'_>,
        depth: usize,
    ) -> Result<Vec<Vec<String>>, Fault> {
        let mut left = message.fields.iter().filter(|f| lists_names(f)).count();
        let mut muted = Walk { types: self.types, row: Row::default(), muted: true, naming: None };
        let mut names = Vec::with_capacity(left);
        for field in &message.fields {
            if left == 0 {
                break;
            }
            let n = match field.count {
                Count::One if self.types.is_header(&field.kind) => {
                    header(&mut bytes)?;
                    continue;
                }
                Count::One => {
                    muted.one(&field.kind, &mut bytes, None, depth)?;
                    continue;
                }
                Count::Fixed(n) => n,
                Count::Sequence => bytes.length()?,
            };
            if lists_names(field) {
                let mut list = Vec::new();
                for _ in 0..n {
                    list.push(String::from_utf8_lossy(bytes.text()?).into_owned());
                }
                names.push(list);
                left -= 1;
            } else {
                muted.several(&field.name, &field.kind, n, &mut bytes, None, depth)?;
            }
        }
        Ok(names)
    }

    fn one(
        &mut self,
        kind: &Kind,
        bytes: &mut Bytes<'_>,
        unit: Option<&'static str>,
        depth: usize,
    ) -> Result<(), Fault> {
        match kind {
            Kind::Number(primitive) => {
                let number = bytes.number(*primitive)?;
                self.put(number, unit, *primitive == Primitive::Bool);
            }
            Kind::Text => {
                bytes.text()?;
            }
            Kind::Time => {
                bytes.nanoseconds()?;
            }
            Kind::Duration => {
                let seconds = bytes.duration()?;
                self.put(seconds, Some("s"), false);
            }
            Kind::Message(place) => self.message(*place, bytes, unit, depth + 1)?,
        }
        Ok(())
    }

    fn several(
        &mut self,
        field: &str,
        kind: &Kind,
        n: usize,
        bytes: &mut Bytes<'_>,
        unit: Option<&'static str>,
        depth: usize,
    ) -> Result<(), Fault> {
        match kind {
            Kind::Text => {
                let told = is_names(field) && !self.muted;
                for _ in 0..n {
                    let text = bytes.text()?;
                    if told {
                        self.row.shape.extend(text);
                        self.row.shape.push(0);
                    }
                }
                return Ok(());
            }
            Kind::Number(primitive @ (Primitive::U8 | Primitive::I8)) => {
                self.leave_out("bytes");
                return bytes.skip(*primitive, n);
            }
            Kind::Number(primitive) if n > MOST => {
                self.leave_out("long arrays");
                self.row.shape.extend(u64::MAX.to_le_bytes());
                return bytes.skip(*primitive, n);
            }
            _ => {}
        }
        let muted = self.muted;
        if n > MOST && *kind != Kind::Time {
            self.leave_out("long arrays");
            self.muted = true;
        }
        self.row.shape.extend((n.min(MOST + 1) as u64).to_le_bytes());
        for index in 0..n {
            let length = self.naming.as_ref().map_or(0, |naming| naming.path.len());
            if let Some(naming) = self.naming.as_mut().filter(|_| !self.muted) {
                let bracket = bracket(&naming.names, index, n);
                naming.path.push_str(&bracket);
            }
            self.one(kind, bytes, unit, depth)?;
            if let Some(naming) = &mut self.naming {
                naming.path.truncate(length);
            }
        }
        self.muted = muted;
        Ok(())
    }

    fn put(&mut self, number: f64, unit: Option<&'static str>, held: bool) {
        if self.muted {
            return;
        }
        self.row.numbers.push(number);
        if let Some(naming) = &mut self.naming {
            naming.columns.push(Column { name: naming.path.clone(), unit, held });
        }
    }

    fn leave_out(&mut self, why: &str) {
        if let Some(naming) = self.naming.as_mut().filter(|_| !self.muted) {
            naming.left_out.insert(naming.path.clone(), why.to_owned());
        }
    }
}

fn lists_names(field: &super::schema::Field) -> bool {
    field.kind == Kind::Text && field.count != Count::One && is_names(&field.name)
}

/// Reads a `std_msgs/Header`: its stamp, ns.
fn header(bytes: &mut Bytes<'_>) -> Result<i64, Fault> {
    if !bytes.is_cdr() {
        // The running number of ROS 1.
        bytes.u32()?;
    }
    let stamp = bytes.nanoseconds()?;
    bytes.text()?;
    Ok(stamp)
}
