//! Message definitions of ROS (`ros2msg`, `ros1msg`): the text to types.
//!
//! The text is the definition of the message, followed by those that it uses, each behind a line of `=` and a line
//! `MSG: package/Type`. A line is `type name`, `type name default` or `type NAME=constant`; a type may be an array:
//! `T[]`, `T[<=n]`, `T[n]`. Constants are in no message, and a default is what its writer fills in: neither is read.

use std::collections::BTreeMap;

/// Deepest nesting of types that is read: no definition of ROS comes near it, and one that holds itself has no end.
const DEEPEST: usize = 32;

/// A number as it stands in a message, `Bool` being 0 or 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Primitive {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

/// What a field holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Kind {
    Number(Primitive),
    Text,
    /// Seconds and nanoseconds: an instant, and how many.
    Time,
    Duration,
    /// Another message, by its place among the [`Types`].
    Message(usize),
}

/// How often a field holds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Count {
    One,
    Fixed(usize),
    /// The message says how many.
    Sequence,
}

/// A field of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) name: String,
    pub(super) kind: Kind,
    pub(super) count: Count,
}

/// A message: `package/Type` and its fields.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct Message {
    pub(super) name: String,
    pub(super) fields: Vec<Field>,
}

/// The message of a topic, which is the first, and those in it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Types(pub(super) Vec<Message>);

impl Types {
    /// Reads the text of a definition called `name`; in `ros1` the words mean what they do there.
    ///
    /// # Errors
    /// What cannot be read, in words.
    pub(super) fn parse(name: &str, text: &str, ros1: bool) -> Result<Types, String> {
        let mut texts = BTreeMap::new();
        let (mut called, mut lines) = (short(name), Vec::new());
        let mut all = text.lines();
        while let Some(line) = all.next() {
            if line.len() >= 3 && line.trim().bytes().all(|b| b == b'=') {
                texts.entry(called).or_insert(std::mem::take(&mut lines));
                let next = all.next().unwrap_or_default().trim();
                called = short(next.strip_prefix("MSG:").unwrap_or(next).trim());
            } else {
                lines.push(line);
            }
        }
        texts.entry(called).or_insert(lines);
        let mut reader = Reader { texts, ros1, types: Vec::new(), places: BTreeMap::new() };
        reader.message(&short(name), 0)?;
        Ok(Types(reader.types))
    }

    /// Whether this is a `std_msgs/Header`.
    pub(super) fn is_header(&self, kind: &Kind) -> bool {
        matches!(kind, Kind::Message(place) if self.0.get(*place).is_some_and(|m| m.name == "std_msgs/Header"))
    }
}

struct Reader<'a> {
    texts: BTreeMap<String, Vec<&'a str>>,
    ros1: bool,
    types: Vec<Message>,
    places: BTreeMap<String, usize>,
}

impl Reader<'_> {
    /// Place of the message called `name` among the types.
    fn message(&mut self, name: &str, depth: usize) -> Result<usize, String> {
        if let Some(&place) = self.places.get(name) {
            return Ok(place);
        }
        if depth > DEEPEST {
            return Err(format!("its types are nested more than {DEEPEST} deep"));
        }
        let lines = self.texts.get(name).cloned().ok_or_else(|| format!("its type {name} is not defined"))?;
        let place = self.types.len();
        self.types.push(Message { name: name.to_owned(), fields: Vec::new() });
        self.places.insert(name.to_owned(), place);
        let mut fields = Vec::with_capacity(lines.len());
        for line in lines {
            if let Some(field) = self.field(line, name, depth)? {
                fields.push(field);
            }
        }
        self.types[place].fields = fields;
        Ok(place)
    }

    /// The field that a line of the message `within` defines.
    fn field(&mut self, line: &str, within: &str, depth: usize) -> Result<Option<Field>, String> {
        let line = line.split('#').next().unwrap_or_default().trim();
        let Some((kind, rest)) = line.split_once(char::is_whitespace) else {
            return if line.is_empty() { Ok(None) } else { Err(format!("its line `{line}` has no name")) };
        };
        let rest = rest.trim_start();
        let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
        let (name, after) = rest.split_at(end);
        if name.is_empty() {
            return Err(format!("its line `{line}` has no name"));
        }
        if after.trim_start().starts_with('=') {
            return Ok(None);
        }
        let (kind, count) = match kind.strip_suffix(']').and_then(|kind| kind.split_once('[')) {
            None => (kind, Count::One),
            Some((kind, "")) => (kind, Count::Sequence),
            Some((kind, bound)) if bound.starts_with("<=") => (kind, Count::Sequence),
            Some((kind, size)) => match size.parse() {
                Ok(size) => (kind, Count::Fixed(size)),
                Err(_) => return Err(format!("its line `{line}` has no size")),
            },
        };
        let kind = self.kind(kind, within, depth)?;
        Ok(Some(Field { name: name.to_owned(), kind, count }))
    }

    fn kind(&mut self, word: &str, within: &str, depth: usize) -> Result<Kind, String> {
        use Primitive::{Bool, F32, F64, I8, I16, I32, I64, U8, U16, U32, U64};
        let number = match word {
            "bool" => Bool,
            "byte" if self.ros1 => I8,
            "int8" => I8,
            "byte" | "char" | "uint8" => U8,
            "int16" => I16,
            "uint16" => U16,
            "int32" => I32,
            "uint32" => U32,
            "int64" => I64,
            "uint64" => U64,
            "float32" => F32,
            "float64" => F64,
            "string" => return Ok(Kind::Text),
            "time" if self.ros1 => return Ok(Kind::Time),
            "duration" if self.ros1 => return Ok(Kind::Duration),
            _ if word.starts_with("string<=") => return Ok(Kind::Text),
            _ if word.starts_with("wstring") => return Err("it holds texts of wide characters".to_owned()),
            _ => return self.other(word, within, depth),
        };
        Ok(Kind::Number(number))
    }

    /// Another message: `package/Type`, or `Type` of the same package.
    fn other(&mut self, word: &str, within: &str, depth: usize) -> Result<Kind, String> {
        let full = match word.contains('/') {
            true => short(word),
            false if self.ros1 && word == "Header" => "std_msgs/Header".to_owned(),
            false => match within.split_once('/') {
                Some((package, _)) => format!("{package}/{word}"),
                None => word.to_owned(),
            },
        };
        match full.as_str() {
            "builtin_interfaces/Time" => Ok(Kind::Time),
            "builtin_interfaces/Duration" => Ok(Kind::Duration),
            _ => self.message(&full, depth + 1).map(Kind::Message),
        }
    }
}

/// `package/Type` of `package/msg/Type`.
fn short(name: &str) -> String {
    name.replace("/msg/", "/")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(name: &str, kind: Kind, count: Count) -> Field {
        Field { name: name.to_owned(), kind, count }
    }

    #[test]
    fn every_kind_of_line_is_read() {
        let text = "# a remark\nbool on\nint32 LIMIT=5\nstring NAME = \"a # b\"\nfloat64[<=4] x # bounded\n\
                    float32[3] y [0.0, 1.0, 2.0]\nstring<=10 label \"none\"\nuint8 n 7\nOther[] others\n\
                    builtin_interfaces/Time at\nbuiltin_interfaces/msg/Duration long\n\
                    =====================\nMSG: a_msgs/Other\nchar c\n";
        let types = Types::parse("a_msgs/msg/Main", text, false).unwrap();
        let number = Kind::Number;
        assert_eq!(types.0[0].name, "a_msgs/Main");
        assert_eq!(
            types.0[0].fields,
            [
                field("on", number(Primitive::Bool), Count::One),
                field("x", number(Primitive::F64), Count::Sequence),
                field("y", number(Primitive::F32), Count::Fixed(3)),
                field("label", Kind::Text, Count::One),
                field("n", number(Primitive::U8), Count::One),
                field("others", Kind::Message(1), Count::Sequence),
                field("at", Kind::Time, Count::One),
                field("long", Kind::Duration, Count::One),
            ]
        );
        assert_eq!(types.0[1].fields, [field("c", number(Primitive::U8), Count::One)]);
    }

    #[test]
    fn words_of_ros_1_mean_what_they_do_there() {
        let text = "Header header\nbyte b\ntime at\n===\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n";
        let types = Types::parse("a_msgs/Main", text, true).unwrap();
        assert!(types.is_header(&types.0[0].fields[0].kind) && !types.is_header(&types.0[0].fields[2].kind));
        assert_eq!(types.0[0].fields[1].kind, Kind::Number(Primitive::I8));
        assert_eq!(types.0[0].fields[2].kind, Kind::Time);
    }

    #[test]
    fn what_cannot_be_read_is_told() {
        let deep: String = (0..60).map(|k| format!("===\nMSG: a/T{k}\nT{} x\n", k + 1)).collect();
        for (text, part) in [
            ("Other x", "its type a/Other is not defined"),
            ("float64", "its line `float64` has no name"),
            ("float64[n] x", "has no size"),
            ("wstring x", "wide characters"),
            (&format!("T0 x\n{deep}"), "more than 32 deep"),
        ] {
            let error = Types::parse("a/Main", text, false).unwrap_err();
            assert!(error.contains(part), "{error}");
        }
        // A message in itself has no end, but a definition.
        assert!(Types::parse("a/Main", "Main x", false).is_ok());
    }
}
