//! Where messages come from: a broker and a topic, as `mosquitto_sub -L` has them.

use std::str::FromStr;

use percent_encoding::percent_decode_str;

use crate::failure::Failure;

/// `mqtt://[user[:password]@]host[:port]/topic`, or `mqtts://…` by TLS.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Address {
    /// By TLS.
    pub(super) secure: bool,
    pub(super) host: String,
    pub(super) port: u16,
    pub(super) user: Option<String>,
    pub(super) password: Option<String>,
    pub(super) topic: String,
}

/// A broker, and the topics that are read of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Source {
    /// That of its first topic.
    pub(super) address: Address,
    pub(super) topics: Vec<String>,
}

impl Source {
    /// The broker of all of these addresses; `None` where there are none.
    ///
    /// # Errors
    /// Bad input: one is no address, or they are of several brokers or users.
    pub(super) fn of(addresses: &[String]) -> Result<Option<Source>, Failure> {
        // (Read here, since clap would print a wrong one with its password.)
        let read = |text: &String| text.parse().map_err(|e| Failure::input(format!("`--from`: {e}")));
        let addresses = addresses.iter().map(read).collect::<Result<Vec<Address>, Failure>>()?;
        let Some((first, others)) = addresses.split_first() else { return Ok(None) };
        let mut source = Source { address: first.clone(), topics: vec![first.topic.clone()] };
        for other in others {
            let (one, another) = (first.broker(), other.broker());
            if one != another {
                return Err(Failure::input(format!("`--from` names two brokers, {one} and {another}"))
                    .help("take all topics from one broker: let one bridge the other's topics, or watch each by itself"));
            }
            let address = &mut source.address;
            match (&address.user, &other.user) {
                (_, None) => {}
                (None, Some(_)) => {
                    (address.user, address.password) = (other.user.clone(), other.password.clone());
                }
                (Some(_), Some(_))
                    if (&address.user, &address.password) == (&other.user, &other.password) => {}
                (Some(_), Some(_)) => {
                    return Err(Failure::input(format!("`--from` logs in at {one} in two ways"))
                        .help("state user and password once, and let the user read all topics"));
                }
            }
            if !source.topics.contains(&other.topic) {
                source.topics.push(other.topic.clone());
            }
        }
        Ok(Some(source))
    }
}

/// The port of MQTT, and that of MQTT by TLS.
const PORT: u16 = 1883;
const SECURE_PORT: u16 = 8883;
/// Most bytes of a text of the protocol.
const LONGEST: usize = 65_535;

impl Address {
    /// The broker in messages, without what is secret.
    pub(super) fn broker(&self) -> String {
        let between = if self.host.contains(':') { ["[", "]"] } else { ["", ""] };
        let scheme = if self.secure { "mqtts" } else { "mqtt" };
        format!("{scheme}://{}{}{}:{}", between[0], self.host, between[1], self.port)
    }
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Address, String> {
        const FORM: &str = "write it like mqtt://broker:1883/plant/throttle, mqtts://… by TLS, or mqtt://user:password@broker/topic";
        let (secure, rest) = match (text.strip_prefix("mqtt://"), text.strip_prefix("mqtts://")) {
            (Some(rest), _) => (false, rest),
            (_, Some(rest)) => (true, rest),
            _ => return Err(format!("this is no address of a broker; {FORM}")),
        };
        // (A topic is taken as it stands: `#` and `?` mean nothing else here.)
        let (authority, topic) = rest.split_once('/').ok_or_else(|| format!("there is no topic; {FORM}"))?;
        let (login, place) = match authority.rsplit_once('@') {
            Some((login, place)) => (Some(login), place),
            None => (None, authority),
        };
        let (host, port) = host_and_port(place).ok_or_else(|| format!("there is no host or port; {FORM}"))?;
        let port = port.unwrap_or(if secure { SECURE_PORT } else { PORT });
        let (user, password) = match login.map(|login| login.split_once(':').unwrap_or((login, ""))) {
            None => (None, None),
            Some((user, password)) => (Some(decoded(user)?), Some(decoded(password)?)),
        };
        check_topic(topic)?;
        let password = password.filter(|p| !p.is_empty());
        Ok(Address { secure, host, port, user, password, topic: topic.to_owned() })
    }
}

fn host_and_port(place: &str) -> Option<(String, Option<u16>)> {
    let (host, port) = match place.strip_prefix('[') {
        // An address of IPv6 has colons of its own.
        Some(rest) => {
            let (host, rest) = rest.split_once(']')?;
            (host, if rest.is_empty() { None } else { Some(rest.strip_prefix(':')?) })
        }
        None => place.split_once(':').map_or((place, None), |(host, port)| (host, Some(port))),
    };
    let port = port.map(str::parse).transpose().ok()?;
    (!host.is_empty()).then(|| (host.to_owned(), port))
}

/// A user or a password, in which `%40` is an `@`.
fn decoded(text: &str) -> Result<String, String> {
    let decoded = percent_decode_str(text).decode_utf8();
    let decoded = decoded.map_err(|_| "user and password are no UTF-8".to_owned())?;
    match decoded.len() > LONGEST {
        true => Err("user and password are too long".to_owned()),
        false => Ok(decoded.into_owned()),
    }
}

/// Sees that a topic may be subscribed to.
fn check_topic(topic: &str) -> Result<(), String> {
    let mut levels = topic.split('/').peekable();
    let mut fits = !topic.is_empty() && topic.len() <= LONGEST && !topic.contains('\0');
    while let Some(level) = levels.next() {
        fits &= match level {
            "#" => levels.peek().is_none(),
            "+" => true,
            level => !level.contains(['#', '+']),
        };
    }
    match fits {
        true => Ok(()),
        false => Err(format!(
            "`{topic}` is no topic: name one, with `+` in the place of a level or `#` in that of the last ones"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn several_addresses_are_topics_of_one_broker() {
        let of =
            |texts: &[&str]| Source::of(&texts.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>());
        assert_eq!(of(&[]).unwrap(), None);
        let joined = of(&["mqtt://h/a", "mqtt://me:secret@h:1883/b/#", "mqtt://h/a", "mqtt://me:secret@h/c"]);
        let Source { address, topics } = joined.unwrap().unwrap();
        assert_eq!(topics, ["a", "b/#", "c"]);
        assert_eq!((address.user.as_deref(), address.password.as_deref()), (Some("me"), Some("secret")));
        for (texts, part) in [
            (["mqtt://h/a", "mqtt://i/a"], "two brokers, mqtt://h:1883 and mqtt://i:1883"),
            (["mqtt://h/a", "mqtts://h/a"], "two brokers, mqtt://h:1883 and mqtts://h:8883"),
            (["mqtt://h/a", "mqtt://h:1884/a"], "two brokers"),
            (["mqtt://h/a", "mqtt://me:secret@h"], "`--from`: there is no topic"),
            (["mqtt://me:secret@h/a", "mqtt://you:secret@h/b"], "logs in at mqtt://h:1883 in two ways"),
            (["mqtt://me:secret@h/a", "mqtt://me:secrets@h/b"], "logs in at mqtt://h:1883 in two ways"),
        ] {
            let said = of(&texts).unwrap_err().to_string();
            assert!(said.contains(part) && !said.contains("secret"), "{said}");
        }
    }

    #[test]
    fn addresses_are_read() {
        let read = |text: &str| text.parse::<Address>();
        let full = read("mqtt://me%40site:a%3Ab%2F@broker.local:1884/plant/+/#").unwrap();
        assert_eq!((full.host.as_str(), full.port, full.topic.as_str()), ("broker.local", 1884, "plant/+/#"));
        assert_eq!((full.user.as_deref(), full.password.as_deref()), (Some("me@site"), Some("a:b/")));
        assert_eq!(full.broker(), "mqtt://broker.local:1884");
        let short = read("mqtt://[::1]//a?b").unwrap();
        assert_eq!((short.broker().as_str(), short.topic.as_str()), ("mqtt://[::1]:1883", "/a?b"));
        assert_eq!((short.user, short.password), (None, None));
        let secure = read("mqtts://broker/topic").unwrap();
        assert_eq!((secure.secure, secure.broker().as_str()), (true, "mqtts://broker:8883"));
        for (text, part) in [
            ("broker/topic", "no address of a broker"),
            ("http://broker/topic", "no address of a broker"),
            ("mqtt://broker", "no topic"),
            ("mqtt://broker/", "`` is no topic"),
            ("mqtt://broker/a#", "`a#` is no topic"),
            ("mqtt://broker/#/a", "`#/a` is no topic"),
            ("mqtt://broker/a+/b", "`a+/b` is no topic"),
            ("mqtt:///topic", "no host or port"),
            ("mqtt://broker:port/topic", "no host or port"),
            ("mqtt://[::1/topic", "no host or port"),
            ("mqtt://%ff@broker/topic", "no UTF-8"),
        ] {
            let said = read(text).unwrap_err();
            assert!(said.contains(part), "{text}: {said}");
        }
    }
}
