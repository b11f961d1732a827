//! Where the samples of a watch come from: what is read elsewhere waits here in a row.

use std::io::{self, BufRead};
use std::sync::mpsc::SyncSender;
use std::thread;

use serde_json::{Value, json};

use super::address::Address;
use crate::failure::Failure;

/// What comes in.
#[derive(Debug)]
pub(super) enum Message {
    /// A line of standard input.
    Line(Vec<u8>),
    /// A message of a broker.
    #[cfg_attr(not(feature = "mqtt"), expect(dead_code, reason = "brokers alone send it"))]
    Payload { topic: String, payload: Vec<u8> },
    /// The connection to a broker.
    #[cfg_attr(not(feature = "mqtt"), expect(dead_code, reason = "brokers alone send it"))]
    Connection(Connection),
    /// Nothing comes any more.
    Failed(Failure),
}

/// What has become of the connection to a broker.
#[derive(Debug)]
pub(super) enum Connection {
    #[cfg_attr(not(feature = "mqtt"), expect(dead_code, reason = "brokers alone say it"))]
    Subscribed { broker: String, topic: String },
    /// It is tried again after `pause` seconds.
    #[cfg_attr(not(feature = "mqtt"), expect(dead_code, reason = "brokers alone say it"))]
    Lost { broker: String, message: String, pause: u64 },
}

impl Connection {
    pub(super) fn to_json(&self) -> Value {
        match self {
            Connection::Subscribed { broker, topic } => {
                json!({ "event": "subscribed", "broker": broker, "topic": topic })
            }
            Connection::Lost { broker, message, pause } => {
                json!({ "event": "disconnected", "broker": broker, "message": message, "pause": pause })
            }
        }
    }

    pub(super) fn in_words(&self) -> String {
        match self {
            Connection::Subscribed { broker, topic } => format!("{broker}: subscribed to `{topic}`\n"),
            Connection::Lost { broker, message, pause } => {
                format!("{broker}: {message}; trying again in {pause} s\n")
            }
        }
    }
}

/// Sends the lines of standard input, until its end or until nobody takes them.
pub(super) fn standard_input(to: SyncSender<Message>) {
    thread::spawn(move || {
        let mut input = io::stdin().lock();
        loop {
            let mut line = Vec::new();
            let message = match input.read_until(b'\n', &mut line) {
                Ok(0) => return,
                Ok(_) => Message::Line(line),
                Err(e) => Message::Failed(Failure::input(format!("standard input cannot be read: {e}"))),
            };
            let over = matches!(message, Message::Failed(_));
            if to.send(message).is_err() || over {
                return;
            }
        }
    });
}

/// Sends the messages of a broker, as long as anybody takes them.
///
/// # Errors
/// Bad input where this greybox knows no brokers.
#[cfg(feature = "mqtt")]
pub(super) fn broker(address: &Address, to: SyncSender<Message>) -> Result<(), Failure> {
    let address = address.clone();
    thread::spawn(move || super::mqtt::follow(&address, &to));
    Ok(())
}

/// As this greybox knows no brokers.
#[cfg(not(feature = "mqtt"))]
pub(super) fn broker(address: &Address, _to: SyncSender<Message>) -> Result<(), Failure> {
    let (broker, topic) = (address.broker(), &address.topic);
    Err(Failure::input(format!("{broker}: this greybox was built without MQTT"))
        .help(format!("install it with `cargo install --features mqtt …`, or pipe `mosquitto_sub -L {broker}/{topic}` into it")))
}
