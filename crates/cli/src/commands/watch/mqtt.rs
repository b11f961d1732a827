//! A subscription at an MQTT broker (version 3.1.1): the protocol is a library's.

use std::collections::VecDeque;
use std::hash::{BuildHasher, RandomState};
use std::io::{ErrorKind, Read};
use std::sync::Arc;
use std::sync::mpsc::SyncSender;
use std::thread;
use std::time::{Duration, Instant};

use greybox_recording::listed;
use mqtt_protocol_core::mqtt::common::Cursor;
use mqtt_protocol_core::mqtt::connection::{ConnectionOptions, Event, TimerKind};
use mqtt_protocol_core::mqtt::packet::v3_1_1::{Connack, Connect, Publish, Suback, Subscribe};
use mqtt_protocol_core::mqtt::packet::{Packet, Qos, SubEntry, SubOpts};
use mqtt_protocol_core::mqtt::prelude::*;
use mqtt_protocol_core::mqtt::result_code::{ConnectReturnCode, MqttError};
use mqtt_protocol_core::mqtt::{Connection as Protocol, Version, role};

use rustls::sign::CertifiedKey;

use super::address::{Address, Source};
use super::connection::{ANSWER, Ended, Stream, lost, no_answer};
use super::now;
use super::source::{Connection, Message};
use crate::failure::Failure;

/// First pause before a lost connection is tried again, in seconds, and the longest: each is twice the one before.
const PAUSES: (u64, u64) = (1, 60);
/// A broker that hears nothing for so long is asked whether it is there.
const KEEP_ALIVE: u16 = 30;
/// Most bytes of a packet.
const LARGEST: u32 = 16 << 20;

use Ended::{Lost, Over, Refused};

/// Sends the messages of a broker, as long as anybody takes them. What fails before the first subscription is an error;
/// afterwards it is reported and tried again.
pub(super) fn follow(source: &Source, certificate: Option<&Arc<CertifiedKey>>, to: &SyncSender<Message>) {
    let (first, longest) = PAUSES;
    let (mut pause, mut ever) = (first, false);
    loop {
        let mut subscribed = false;
        let ended = match Subscription::open(source, certificate, to) {
            Ok(mut subscription) => {
                let Err(ended) = subscription.follow();
                subscribed = subscription.subscribed;
                ended
            }
            Err(ended) => ended,
        };
        let broker = source.address.broker();
        ever |= subscribed;
        let (message, help) = match ended {
            Over => return,
            Lost(message) => (message, "see that the broker runs there, and that its address is right"),
            Refused(message, help) => (message, help),
        };
        if !ever {
            // (Where nobody takes it the watch has ended.)
            let _ = to.send(Message::Failed(Failure::input(format!("{broker}: {message}")).help(help)));
            return;
        }
        pause = if subscribed { first } else { (2 * pause).min(longest) };
        if to.send(Message::Connection(Connection::Lost { broker, message, pause })).is_err() {
            return;
        }
        thread::sleep(Duration::from_secs(pause));
    }
}

/// A connection, from its first byte to its end.
struct Subscription<'a> {
    source: &'a Source,
    to: &'a SyncSender<Message>,
    stream: Stream,
    protocol: Protocol<role::Client>,
    timers: Vec<(TimerKind, Instant)>,
    /// When it is given up where the broker has not confirmed it.
    confirmed_by: Instant,
    subscribed: bool,
}

enum Never {}

impl<'a> Subscription<'a> {
    fn open(
        source: &'a Source,
        certificate: Option<&Arc<CertifiedKey>>,
        to: &'a SyncSender<Message>,
    ) -> Result<Self, Ended> {
        let options = ConnectionOptions::new().maximum_packet_size_recv(LARGEST);
        let mut protocol = Protocol::with_options(Version::V3_1_1, options);
        protocol.set_auto_pub_response(true);
        protocol.set_pingresp_recv_timeout(ANSWER.as_millis() as u64);
        Ok(Subscription {
            source,
            to,
            stream: Stream::open(&source.address, certificate)?,
            protocol,
            timers: Vec::new(),
            confirmed_by: now() + ANSWER,
            subscribed: false,
        })
    }

    /// Greets, subscribes, and takes what comes until the connection ends.
    fn follow(&mut self) -> Result<Never, Ended> {
        let connect = connect(&self.source.address).map_err(unfit)?;
        let events = self.protocol.checked_send(connect);
        self.handle(events)?;
        let mut buffer = vec![0; 1 << 16];
        loop {
            let left = self.next_timer().saturating_duration_since(now());
            let wait = left.max(Duration::from_millis(1));
            self.stream.wait_at_most(wait).map_err(|e| lost(&e))?;
            match self.stream.read(&mut buffer) {
                Ok(0) => return Err(self.stream.closed()),
                Ok(read) => {
                    let mut bytes = Cursor::new(&buffer[..read]);
                    // (One packet at a time.)
                    while bytes.position() < read as u64 {
                        let events = self.protocol.recv(&mut bytes);
                        self.handle(events)?;
                    }
                }
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return Err(self.stream.lost(&e)),
            }
            self.fire()?;
        }
    }

    fn next_timer(&self) -> Instant {
        let timers = self.timers.iter().map(|(_, at)| *at);
        let confirmed = (!self.subscribed).then_some(self.confirmed_by);
        timers.chain(confirmed).min().unwrap_or_else(|| now() + ANSWER)
    }

    /// Does what is due.
    fn fire(&mut self) -> Result<(), Ended> {
        let now = now();
        if !self.subscribed && now >= self.confirmed_by {
            return Err(no_answer());
        }
        let due: Vec<TimerKind> = self.timers.iter().filter(|(_, at)| now >= *at).map(|(k, _)| *k).collect();
        self.timers.retain(|(_, at)| now < *at);
        for kind in due {
            if kind == TimerKind::PingrespRecv {
                return Err(no_answer());
            }
            let events = self.protocol.notify_timer_fired(kind);
            self.handle(events)?;
        }
        Ok(())
    }

    /// Does what the protocol asks for.
    fn handle(&mut self, events: Vec<Event>) -> Result<(), Ended> {
        let mut events = VecDeque::from(events);
        while let Some(event) = events.pop_front() {
            match event {
                Event::RequestSendPacket { packet, .. } => {
                    self.stream.send(&packet.to_continuous_buffer())?;
                }
                Event::NotifyPacketReceived(packet) => events.extend(self.take(&packet)?),
                Event::RequestTimerReset { kind, duration_ms } => {
                    self.timers.retain(|(k, _)| *k != kind);
                    self.timers.push((kind, now() + Duration::from_millis(duration_ms)));
                }
                Event::RequestTimerCancel(kind) => self.timers.retain(|(k, _)| *k != kind),
                Event::NotifyError(error) => {
                    return Err(Lost(format!("this is not MQTT 3.1.1 as it is expected ({error})")));
                }
                // (What is wrong comes with the next event, where there is one.)
                Event::RequestClose if events.is_empty() => {
                    return Err(Lost("the protocol ends the connection".to_owned()));
                }
                Event::RequestClose | Event::NotifyPacketIdReleased(_) => {}
            }
        }
        Ok(())
    }

    /// Takes a packet of the broker.
    fn take(&mut self, packet: &Packet) -> Result<Vec<Event>, Ended> {
        match packet {
            Packet::V3_1_1Connack(answer) => {
                self.stream.accepted();
                accepted(answer)?;
                let id = self.protocol.acquire_packet_id().map_err(unfit)?;
                // At least once: what comes twice is passed over as a repeated sample.
                let options = SubOpts::new().set_qos(Qos::AtLeastOnce);
                let entries = self.source.topics.iter().map(|topic| SubEntry::new(topic, options));
                let entries = entries.collect::<Result<Vec<_>, _>>().map_err(unfit)?;
                let subscribe = Subscribe::builder().packet_id(id).entries(entries).build();
                Ok(self.protocol.checked_send(subscribe.map_err(unfit)?))
            }
            Packet::V3_1_1Suback(answer) => {
                self.confirm(answer)?;
                Ok(Vec::new())
            }
            Packet::V3_1_1Publish(publish) => {
                self.deliver(publish)?;
                Ok(Vec::new())
            }
            _ => Ok(Vec::new()),
        }
    }

    fn confirm(&mut self, answer: &Suback) -> Result<(), Ended> {
        let codes = answer.return_codes();
        // (One code a topic; a broker that sends fewer has not taken the others.)
        let topics = self.source.topics.iter().enumerate();
        let refused = topics.filter(|(k, _)| !codes.get(*k).is_some_and(|code| code.is_success()));
        let refused: Vec<String> = refused.map(|(_, topic)| format!("`{topic}`")).collect();
        if !refused.is_empty() {
            let help = "see what the broker lets this user read, in its access control list";
            return Err(Refused(format!("the broker refuses the subscription to {}", listed(refused)), help));
        }
        self.subscribed = true;
        for topic in &self.source.topics {
            let (broker, topic) = (self.source.address.broker(), topic.clone());
            self.send(Message::Connection(Connection::Subscribed { broker, topic }))?;
        }
        Ok(())
    }

    /// Passes a message on; one that the broker has kept from before the subscription is no new sample.
    fn deliver(&mut self, publish: &Publish) -> Result<(), Ended> {
        if publish.retain() {
            return Ok(());
        }
        let (topic, payload) = (publish.topic_name().to_owned(), publish.payload().as_slice().to_vec());
        self.send(Message::Payload { topic, payload })
    }

    fn send(&self, message: Message) -> Result<(), Ended> {
        self.to.send(message).map_err(|_| Over)
    }
}

/// The first packet. The session is a clean one: the broker keeps nothing for this client while it is not there.
fn connect(address: &Address) -> Result<Connect, MqttError> {
    // Two clients with one name would take each other's place; `RandomState` differs from process to process.
    let name = format!("greybox{:016x}", RandomState::new().hash_one(std::process::id()));
    let mut connect = Connect::builder().client_id(name)?.clean_session(true).keep_alive(KEEP_ALIVE);
    if let Some(user) = &address.user {
        connect = connect.user_name(user)?;
    }
    if let Some(password) = &address.password {
        connect = connect.password(password.as_str())?;
    }
    connect.build()
}

fn accepted(answer: &Connack) -> Result<(), Ended> {
    let login = "state user and password: `--from mqtt://user:password@host/topic`";
    let (what, help) = match answer.return_code() {
        ConnectReturnCode::Accepted => return Ok(()),
        ConnectReturnCode::BadUserNameOrPassword => ("it does not take this user and password", login),
        ConnectReturnCode::NotAuthorized => ("it does not let this user in", login),
        ConnectReturnCode::UnacceptableProtocolVersion => {
            ("it does not speak MQTT 3.1.1", "let the broker accept MQTT 3.1.1 beside MQTT 5")
        }
        ConnectReturnCode::IdentifierRejected => {
            ("it does not take the client's name", "let the broker accept names that begin with `greybox`")
        }
        ConnectReturnCode::ServerUnavailable => ("it is not available", "try again later"),
    };
    Err(Refused(format!("the broker refuses the connection: {what}"), help))
}

/// What the protocol has no room for.
fn unfit(error: MqttError) -> Ended {
    Refused(format!("user, password or topic cannot be sent ({error})"), "state them shorter")
}
