//! Where the samples of a watch come from: what is read elsewhere waits here in a row.

use std::io::{self, BufRead};
use std::path::Path;
use std::sync::mpsc::SyncSender;
use std::thread;

use serde_json::{Value, json};

use super::address::Source;
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

/// Files of the certificate of this client, and of its key where that stands apart.
#[derive(Debug, Clone, Copy)]
pub(super) struct Certificate<'a> {
    pub(super) certificate: &'a Path,
    #[cfg_attr(not(feature = "mqtt"), expect(dead_code, reason = "connections alone read it"))]
    pub(super) key: Option<&'a Path>,
}

/// Sends the messages of a broker, as long as anybody takes them.
///
/// # Errors
/// Bad input: a certificate that does not fit, or any broker where this greybox knows none.
pub(super) fn broker(
    source: Source,
    certificate: Option<Certificate<'_>>,
    to: SyncSender<Message>,
) -> Result<(), Failure> {
    if let (Some(Certificate { certificate, .. }), false) = (certificate, source.address.secure) {
        return Err(Failure::input(format!(
            "{}: `--cert {}` is for TLS, and this address is without",
            source.address.broker(),
            certificate.display()
        ))
        .help("write `mqtts://…` (port 8883 where none is stated), or leave `--cert` out"));
    }
    follow(source, certificate, to)
}

#[cfg(feature = "mqtt")]
fn follow(
    source: Source,
    certificate: Option<Certificate<'_>>,
    to: SyncSender<Message>,
) -> Result<(), Failure> {
    let certificate = certificate.map(|c| super::certificate::read(c.certificate, c.key)).transpose()?;
    thread::spawn(move || super::mqtt::follow(&source, certificate.as_ref(), &to));
    Ok(())
}

/// As this greybox knows no brokers.
#[cfg(not(feature = "mqtt"))]
fn follow(
    source: Source,
    _certificate: Option<Certificate<'_>>,
    _to: SyncSender<Message>,
) -> Result<(), Failure> {
    let broker = source.address.broker();
    let topics: Vec<String> = source.topics.iter().map(|topic| format!(" -t '{topic}'")).collect();
    let pipe = match topics.len() {
        1 => format!("mosquitto_sub -L {broker}/{}", source.address.topic),
        _ => {
            format!("mosquitto_sub -h {} -p {}{}", source.address.host, source.address.port, topics.concat())
        }
    };
    Err(Failure::input(format!("{broker}: this greybox was built without MQTT"))
        .help(format!("install it with `cargo install --features mqtt …`, or pipe `{pipe}` into it")))
}
