//! The container, by the library: schemas, channels and messages in the order of the file, to topics.

use super::topic::{Encoding, Topic};
use crate::file::ROOM;
use ::mcap::records::{Record, op};
use ::mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use ::mcap::{McapError, parse_record};
use std::collections::BTreeMap;

/// Longest record that is read, bytes: an image of 50 million points. What a damaged length asks for is never more.
const LONGEST: usize = 256 << 20;

/// Bytes that the library is given at a time, where it does not ask for more.
const BLOCK: usize = 1 << 16;

/// Why a file cannot be read.
pub(super) enum Fault {
    Library(McapError),
    TooLarge { topic: String },
}

impl From<McapError> for Fault {
    fn from(error: McapError) -> Fault {
        Fault::Library(error)
    }
}

/// What a file holds.
#[derive(Default)]
pub(super) struct Content {
    /// The topics that are read, in the order in which the file names them.
    pub(super) topics: Vec<Topic>,
    /// Those that are not, and why.
    pub(super) others: BTreeMap<String, String>,
}

/// Reads the topics of a file of which `wanted` says that they are.
///
/// # Errors
/// Bytes that are no such file, or are damaged; values that need more than [`ROOM`].
pub(super) fn content(bytes: &[u8], wanted: &dyn Fn(&str) -> bool) -> Result<Content, Fault> {
    let options = LinearReaderOptions::default()
        .with_record_length_limit(LONGEST)
        .with_validate_chunk_crcs(true)
        .with_validate_data_section_crc(true)
        .with_validate_summary_section_crc(true);
    let mut reader = LinearReader::new_with_options(options);
    let mut rest = bytes;
    let mut read = Reading::new(wanted);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(asked) => {
                let (given, left) = rest.split_at(asked.max(BLOCK).min(rest.len()));
                reader.insert(given.len()).copy_from_slice(given);
                reader.notify_read(given.len());
                rest = left;
            }
            LinearReadEvent::Record { opcode: opcode @ (op::SCHEMA | op::CHANNEL | op::MESSAGE), data } => {
                if !texts_fit(opcode, data) {
                    return Err(McapError::UnexpectedEoc.into());
                }
                read.record(parse_record(opcode, data)?)?;
            }
            LinearReadEvent::Record { .. } => {}
        }
    }
    Ok(read.content)
}

/// Whether the texts of a schema or a channel lie within the record: the library makes room for what their lengths say.
fn texts_fit(opcode: u8, record: &[u8]) -> bool {
    match opcode {
        op::SCHEMA => record.get(2..).and_then(behind_text).and_then(behind_text).is_some(),
        op::CHANNEL => {
            let metadata = record.get(4..).and_then(behind_text).and_then(behind_text);
            let mut pairs = metadata.and_then(|bytes| bytes.get(4..)?.get(..length(bytes)?));
            while let Some(bytes) = pairs.filter(|bytes| !bytes.is_empty()) {
                pairs = behind_text(bytes);
            }
            pairs.is_some()
        }
        _ => true,
    }
}

/// The length with which bytes begin.
fn length(bytes: &[u8]) -> Option<usize> {
    let length = bytes.get(..4)?.try_into().ok()?;
    usize::try_from(u32::from_le_bytes(length)).ok()
}

/// What stands behind the text with which bytes begin.
fn behind_text(bytes: &[u8]) -> Option<&[u8]> {
    bytes.get(4..)?.get(length(bytes)?..)
}

/// The state of the reading.
struct Reading<'a> {
    wanted: &'a dyn Fn(&str) -> bool,
    /// Name, language and text of each definition.
    schemas: BTreeMap<u16, (String, String, Vec<u8>)>,
    /// The place of each channel's topic; `None` where it is not read.
    channels: BTreeMap<u16, Option<usize>>,
    content: Content,
    room: u64,
}

impl<'a> Reading<'a> {
    fn new(wanted: &'a dyn Fn(&str) -> bool) -> Reading<'a> {
        Reading {
            wanted,
            schemas: BTreeMap::new(),
            channels: BTreeMap::new(),
            content: Content::default(),
            room: ROOM / 8,
        }
    }

    fn record(&mut self, record: Record<'_>) -> Result<(), Fault> {
        match record {
            Record::Schema { header, data } => {
                self.schemas.entry(header.id).or_insert((header.name, header.encoding, data.into_owned()));
            }
            Record::Channel(channel) if !self.channels.contains_key(&channel.id) => {
                let place = self.topic(&channel);
                self.channels.insert(channel.id, place);
            }
            Record::Message { header, data } => {
                let Some(place) = self.channels.get(&header.channel_id) else {
                    return Err(McapError::UnknownChannel(header.sequence, header.channel_id).into());
                };
                if let Some(topic) = place.and_then(|place| self.content.topics.get_mut(place)) {
                    topic.take(i64::try_from(header.log_time).unwrap_or(i64::MAX), &data);
                    self.room = self
                        .room
                        .checked_sub(topic.width())
                        .ok_or_else(|| Fault::TooLarge { topic: topic.name.clone() })?;
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// The place of the topic that a channel belongs to.
    fn topic(&mut self, channel: &::mcap::records::Channel) -> Option<usize> {
        if !(self.wanted)(&channel.topic) {
            return None;
        }
        let (name, language, text) = match self.schemas.get(&channel.schema_id) {
            Some((name, language, text)) => (name.as_str(), language.as_str(), text.as_slice()),
            None => ("", "", &[][..]),
        };
        let encoding = match Encoding::of(&channel.message_encoding, language, name, text) {
            Ok(encoding) => encoding,
            Err(why) => {
                self.content.others.insert(channel.topic.clone(), why);
                return None;
            }
        };
        match self.content.topics.iter().position(|topic| topic.name == channel.topic) {
            Some(place) if self.content.topics[place].speaks(&encoding) => Some(place),
            Some(_) => {
                let why = "another type of messages than the first stands there too, which is left out";
                self.content.others.insert(channel.topic.clone(), why.to_owned());
                None
            }
            None => {
                self.content.topics.push(Topic::new(channel.topic.clone(), encoding));
                Some(self.content.topics.len() - 1)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A record as the library writes it fits; one whose lengths were changed asks for no memory.
    #[test]
    fn texts_beyond_their_record_are_seen() {
        let text = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
        let schema = [&[1, 0][..], &text("a/B"), &text("ros2msg"), &text("float64 x")].concat();
        let pairs = [text("key"), text("value")].concat();
        let metadata = [&(pairs.len() as u32).to_le_bytes()[..], &pairs].concat();
        let channel = [&[1, 0, 1, 0][..], &text("/topic"), &text("cdr"), &metadata, &[9; 3]].concat();
        for (opcode, record, last) in [(op::SCHEMA, schema, 20), (op::CHANNEL, channel, 41)] {
            assert!(texts_fit(opcode, &record) && parse_record(opcode, &record).is_ok());
            for end in 0..last {
                assert!(!texts_fit(opcode, &record[..end]), "{opcode} cut at {end}");
            }
            assert!(texts_fit(opcode, &record[..last]));
            let mut huge = record.clone();
            let first = if opcode == op::SCHEMA { 5 } else { 7 };
            huge[first] = 0xff;
            assert!(!texts_fit(opcode, &huge));
        }
    }
}
