//! The messages of one topic, to series on one clock.

use super::cdr::Bytes;
use super::fields::{self, Column, Row};
use super::json;
use super::schema::Types;
use std::collections::BTreeMap;

/// How the messages of a topic are read.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Encoding {
    Cdr(Types),
    Ros1(Types),
    Json,
}

impl Encoding {
    /// How messages in `encoding` are read whose definition is called `name` and written as `text` in the language `schema`.
    ///
    /// # Errors
    /// Why they are not, in words.
    pub(super) fn of(encoding: &str, schema: &str, name: &str, text: &[u8]) -> Result<Encoding, String> {
        let text = || std::str::from_utf8(text).map_err(|_| "its definition is no text".to_owned());
        match (encoding, schema) {
            ("cdr", "ros2msg") => Types::parse(name, text()?, false).map(Encoding::Cdr),
            ("ros1", "ros1msg") => Types::parse(name, text()?, true).map(Encoding::Ros1),
            ("json", _) => Ok(Encoding::Json),
            (_, "") => Err(format!("its messages are `{encoding}` without a definition")),
            (_, schema) if schema == encoding => Err(format!("its messages are `{encoding}`")),
            (_, schema) => Err(format!("its messages are `{encoding}`, defined in `{schema}`")),
        }
    }
}

/// The messages of a topic that were read so far.
#[derive(Debug)]
pub(super) struct Topic {
    pub(super) name: String,
    encoding: Encoding,
    /// When each message was logged, ns.
    pub(super) logged: Vec<i64>,
    /// Stamps of the messages, ns, of those that have one.
    stamps: Vec<i64>,
    /// Names and values; a column that ends early, or begins late, has no value for the other messages.
    pub(super) columns: Vec<(Column, Vec<f64>)>,
    index: BTreeMap<String, usize>,
    /// Shape of the last message, and the columns of its numbers.
    shape: Option<Vec<u8>>,
    places: Vec<usize>,
    /// What is left out of its messages, and why.
    pub(super) left_out: BTreeMap<String, String>,
    /// Why it is left out as a whole.
    pub(super) fault: Option<String>,
}

impl Topic {
    pub(super) fn new(name: String, encoding: Encoding) -> Topic {
        Topic {
            name,
            encoding,
            logged: Vec::new(),
            stamps: Vec::new(),
            columns: Vec::new(),
            index: BTreeMap::new(),
            shape: None,
            places: Vec::new(),
            left_out: BTreeMap::new(),
            fault: None,
        }
    }

    /// Whether messages of this encoding belong to it too.
    pub(super) fn speaks(&self, encoding: &Encoding) -> bool {
        self.encoding == *encoding
    }

    /// Takes a message that was logged at `logged`, ns; one that cannot be read ends the topic.
    pub(super) fn take(&mut self, logged: i64, message: &[u8]) {
        if self.fault.is_some() {
            return;
        }
        if let Err(why) = self.read(logged, message) {
            self.fault = Some(format!("message {}: {why}", self.logged.len() + 1));
        }
    }

    fn read(&mut self, logged: i64, message: &[u8]) -> Result<(), String> {
        let (row, named) = match &self.encoding {
            Encoding::Cdr(types) => (fields::numbers(types, Bytes::cdr(message)?)?, None),
            Encoding::Ros1(types) => (fields::numbers(types, Bytes::packed(message))?, None),
            Encoding::Json => {
                let json::Numbers { row, columns, left_out } = json::numbers(message, &self.name)?;
                (row, Some((columns, left_out)))
            }
        };
        let Row { numbers, shape, stamp } = row;
        if self.shape.as_ref() != Some(&shape) {
            let (columns, left_out) = match (&self.encoding, named) {
                (_, Some(named)) => named,
                (Encoding::Cdr(types), None) => fields::columns(types, Bytes::cdr(message)?, &self.name)?,
                (Encoding::Ros1(types), None) => fields::columns(types, Bytes::packed(message), &self.name)?,
                (Encoding::Json, None) => return Err("it has no names".to_owned()),
            };
            self.places = columns.into_iter().map(|column| self.place(column)).collect();
            self.left_out.extend(left_out);
            self.shape = Some(shape);
        }
        let row = self.logged.len();
        for (&place, number) in self.places.iter().zip(numbers) {
            let values = &mut self.columns[place].1;
            values.resize(row, f64::NAN);
            values.push(number);
        }
        self.logged.push(logged);
        self.stamps.extend(stamp);
        Ok(())
    }

    fn place(&mut self, column: Column) -> usize {
        let (columns, index) = (&mut self.columns, &mut self.index);
        *index.entry(column.name.clone()).or_insert_with(|| {
            columns.push((column, Vec::new()));
            columns.len() - 1
        })
    }

    /// The stamps, where every message has one that is set.
    pub(super) fn stamps(&self) -> Option<&[i64]> {
        let set = self.stamps.len() == self.logged.len() && self.stamps.iter().all(|&stamp| stamp != 0);
        set.then_some(self.stamps.as_slice()).filter(|stamps| !stamps.is_empty())
    }

    /// Memory that the next message may need, in numbers.
    pub(super) fn width(&self) -> u64 {
        self.columns.len() as u64 + 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATE: &str = "std_msgs/Header header\nstring[] name\nfloat64[] position\nuint8[] image\n\
                         ===\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";

    /// A message with these joints and positions, stamped at `sec`.
    fn state(sec: i32, joints: &[(&str, f64)]) -> Vec<u8> {
        let mut bytes = vec![0, 1, 0, 0];
        let pad = |bytes: &mut Vec<u8>, n: usize| {
            while !(bytes.len() - 4).is_multiple_of(n) {
                bytes.push(0);
            }
        };
        let text = |bytes: &mut Vec<u8>, text: &str| {
            while !(bytes.len() - 4).is_multiple_of(4) {
                bytes.push(0);
            }
            bytes.extend((text.len() as u32 + 1).to_le_bytes());
            bytes.extend(text.as_bytes());
            bytes.push(0);
        };
        bytes.extend(sec.to_le_bytes());
        bytes.extend(0u32.to_le_bytes());
        text(&mut bytes, "base");
        pad(&mut bytes, 4);
        bytes.extend((joints.len() as u32).to_le_bytes());
        for (name, _) in joints {
            text(&mut bytes, name);
        }
        pad(&mut bytes, 4);
        bytes.extend((joints.len() as u32).to_le_bytes());
        for (_, position) in joints {
            pad(&mut bytes, 8);
            bytes.extend(position.to_le_bytes());
        }
        bytes.extend(2u32.to_le_bytes());
        bytes.extend([1, 2]);
        bytes
    }

    fn topic() -> Topic {
        Topic::new("/j".to_owned(), Encoding::of("cdr", "ros2msg", "a/State", STATE.as_bytes()).unwrap())
    }

    /// Joints that change places keep their series; one that is not in a message misses that sample.
    #[test]
    fn joints_keep_their_series() {
        let mut topic = topic();
        topic.take(1, &state(5, &[("a", 1.0), ("b", 2.0)]));
        topic.take(2, &state(6, &[("b", 3.0), ("a", 4.0)]));
        topic.take(3, &state(7, &[("b", 5.0)]));
        topic.take(4, &state(8, &[("a", 6.0), ("b", 7.0)]));
        assert_eq!(topic.fault, None);
        let names: Vec<&str> = topic.columns.iter().map(|(c, _)| c.name.as_str()).collect();
        assert_eq!(names, ["/j.position[a]", "/j.position[b]"]);
        let a = &topic.columns[0].1;
        assert_eq!((a[0], a[1], a[2].is_nan(), a[3]), (1.0, 4.0, true, 6.0));
        assert_eq!(topic.columns[1].1, [2.0, 3.0, 5.0, 7.0]);
        assert_eq!(topic.stamps(), Some(&[5_000_000_000, 6_000_000_000, 7_000_000_000, 8_000_000_000][..]));
        assert_eq!(topic.left_out.keys().collect::<Vec<_>>(), ["/j.image"]);
    }

    #[test]
    fn names_that_stand_twice_name_nothing_and_stamps_of_zero_are_none() {
        let mut topic = topic();
        topic.take(1, &state(0, &[("a", 1.0), ("a", 2.0)]));
        assert_eq!(topic.columns[1].0.name, "/j.position[1]");
        assert_eq!(topic.stamps(), None);
        topic.take(2, &[0, 1, 0, 0, 5]);
        assert_eq!(topic.fault.as_deref(), Some("message 2: it ends too early"));
    }

    /// The same in ROS 1: no gaps before numbers, no zero behind a text.
    #[test]
    fn messages_of_ros_1_are_packed() {
        let text = "Header header\nstring frame\nfloat64[] x\nbool on\nint16 n\n===\nMSG: std_msgs/Header\n\
                    uint32 seq\ntime stamp\nstring frame_id\n";
        let mut topic =
            Topic::new("/r".to_owned(), Encoding::of("ros1", "ros1msg", "a/R", text.as_bytes()).unwrap());
        let words = [7u32, 5, 9, 1].map(u32::to_le_bytes).concat();
        let message = [
            &words[..],
            b"b",
            &3u32.to_le_bytes(),
            b"odd",
            &1u32.to_le_bytes(),
            &2.5f64.to_le_bytes(),
            &[1],
            &(-3i16).to_le_bytes(),
        ]
        .concat();
        topic.take(1, &message);
        assert_eq!(topic.fault, None);
        let found: Vec<(&str, f64)> = topic.columns.iter().map(|(c, v)| (c.name.as_str(), v[0])).collect();
        assert_eq!(found, [("/r.x[0]", 2.5), ("/r.on", 1.0), ("/r.n", -3.0)]);
        assert_eq!(topic.stamps(), Some(&[5_000_000_009][..]));
    }

    #[test]
    fn other_encodings_are_told() {
        for (encoding, schema, part) in [
            ("protobuf", "protobuf", "are `protobuf`"),
            ("cdr", "ros2idl", "in `ros2idl`"),
            ("cbor", "", "without"),
        ] {
            assert!(Encoding::of(encoding, schema, "a/B", b"").unwrap_err().contains(part), "{encoding}");
        }
    }
}
