//! Lines of the Influx line protocol, as Telegraf writes them
//! (<https://docs.influxdata.com/influxdb/v2/reference/syntax/line-protocol/>):
//!
//! ```text
//! measurement[,tag=value…] field=value[,field=value…] timestamp
//! ```
//!
//! The timestamp is in nanoseconds since 1970. Only numbers and truth values are read; tags are passed over.

use greybox_recording::{Stamp, Zone};

/// A line: its measurement, the fields that are numbers (others are `None`), and its time in nanoseconds.
#[derive(Debug, PartialEq)]
pub(super) struct Line {
    measurement: String,
    fields: Vec<(String, Option<f64>)>,
    timestamp: Option<i64>,
}

/// What is left of a line, read from its front.
struct Rest<'a>(&'a str);

impl Rest<'_> {
    /// A name up to one of these characters, which stays; a backslash takes the meaning from the character after it, where
    /// it has one.
    fn name(&mut self, ends: &[char]) -> String {
        let mut name = String::new();
        let mut characters = self.0.char_indices().peekable();
        while let Some((at, c)) = characters.next() {
            match characters.peek() {
                Some(&(_, next)) if c == '\\' && [',', '=', ' '].contains(&next) => {
                    name.push(next);
                    characters.next();
                }
                _ if ends.contains(&c) => {
                    self.0 = &self.0[at..];
                    return name;
                }
                _ => name.push(c),
            }
        }
        self.0 = "";
        name
    }

    fn takes(&mut self, c: char) -> bool {
        match self.0.strip_prefix(c) {
            Some(rest) => {
                self.0 = rest;
                true
            }
            None => false,
        }
    }

    /// The value of a field; `None` for a text.
    fn value(&mut self) -> Result<Option<f64>, String> {
        if self.takes('"') {
            let mut escaped = false;
            let end = self.0.char_indices().find(|(_, c)| {
                let ends = *c == '"' && !escaped;
                escaped = *c == '\\' && !escaped;
                ends
            });
            let (at, _) = end.ok_or("a text has no end")?;
            self.0 = &self.0[at + 1..];
            return Ok(None);
        }
        let text = self.name(&[',', ' ']);
        number(&text).map(Some).ok_or_else(|| format!("`{text}` is no value of a field"))
    }
}

/// A float, an integer (`3i`, `3u`) or a truth value.
fn number(text: &str) -> Option<f64> {
    match text {
        "t" | "T" | "true" | "True" | "TRUE" => return Some(1.0),
        "f" | "F" | "false" | "False" | "FALSE" => return Some(0.0),
        _ => {}
    }
    let integer = text.strip_suffix(['i', 'u']);
    match integer {
        Some(digits) => digits.parse::<i128>().ok().map(|value| value as f64),
        None => text.parse().ok().filter(|value: &f64| value.is_finite()),
    }
}

/// Whether the first line is of this protocol.
pub(super) fn is_influx(text: &str) -> bool {
    text.starts_with('#') || parse(text).is_ok()
}

/// Reads a line.
///
/// # Errors
/// What is wrong with it.
pub(super) fn parse(text: &str) -> Result<Line, String> {
    let mut rest = Rest(text.trim());
    let measurement = rest.name(&[',', ' ']);
    if measurement.is_empty() {
        return Err("there is no measurement".to_owned());
    }
    while rest.takes(',') {
        rest.name(&['=']);
        if !rest.takes('=') {
            return Err("a tag has no value".to_owned());
        }
        rest.name(&[',', ' ']);
    }
    let mut fields = Vec::new();
    rest.0 = rest.0.trim_start();
    loop {
        let name = rest.name(&['=', ' ']);
        if name.is_empty() || !rest.takes('=') {
            return Err("this is no `field=value`".to_owned());
        }
        fields.push((name, rest.value()?));
        if !rest.takes(',') {
            break;
        }
    }
    let timestamp = match rest.0.trim() {
        "" => None,
        text => Some(text.parse().map_err(|_| format!("`{text}` is no timestamp in nanoseconds"))?),
    };
    Ok(Line { measurement, fields, timestamp })
}

impl Line {
    /// Time and the values of `keys`, each `field` or `measurement.field`; NaN for one that is not there, and `None` where
    /// none of them is.
    ///
    /// # Errors
    /// No timestamp, or a text in the place of a number.
    pub(super) fn row(&self, keys: &[String]) -> Result<Option<(Stamp, Vec<f64>)>, String> {
        let of = |key: &String| {
            let inner = key.strip_prefix(&self.measurement).and_then(|rest| rest.strip_prefix('.'));
            self.fields.iter().find(|(name, _)| name == key || Some(name.as_str()) == inner)
        };
        let found: Vec<_> = keys.iter().map(of).collect();
        if found.iter().all(Option::is_none) {
            return Ok(None);
        }
        let nanoseconds = self.timestamp.ok_or("there is no timestamp, in nanoseconds")?;
        let values = found.into_iter().map(|field| match field {
            None => Ok(f64::NAN),
            Some((_, Some(value))) => Ok(*value),
            Some((name, None)) => Err(format!("`{name}` is a text, not a number")),
        });
        let stamp = Stamp::count(nanoseconds.into(), 1_000_000_000, Zone::Offset(0));
        Ok(Some((stamp, values.collect::<Result<_, _>>()?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(text: &str, keys: &[&str]) -> Result<Option<Vec<f64>>, String> {
        let keys: Vec<String> = keys.iter().map(|key| (*key).to_owned()).collect();
        let found = parse(text)?.row(&keys)?;
        Ok(found.map(|(time, values)| std::iter::once(time.after(0)).chain(values).collect()))
    }

    /// The lines of the documentation of the protocol, and what it says of escapes.
    #[test]
    fn lines_are_read() {
        let line = r#"throttle,site=a\ b,unit=7 angle=12.5,torque=-3i,on=T,state="run, \"fast\" mode" 1556813561098000000"#;
        assert_eq!(
            row(line, &["throttle.angle", "torque", "on"]),
            Ok(Some(vec![1_556_813_561.098, 12.5, -3.0, 1.0]))
        );
        let line = r"my\ rig,k=v motor\ angle=1e-3,a\=b=2u 1000000000";
        assert_eq!(row(line, &["motor angle", "a=b"]), Ok(Some(vec![1.0, 1e-3, 2.0])));
        let Ok(Some(part)) = row("m a=1 0", &["a", "b"]) else { panic!("a row") };
        assert!(part[1] == 1.0 && part[2].is_nan());
        let Ok(Some((time, _))) = parse("m a=1 1556813561123456789").unwrap().row(&["a".to_owned()]) else {
            panic!("a row")
        };
        assert_eq!((time.after(1_556_813_561), time.zone), (0.123_456_789, Zone::Offset(0)));
        // A line of something else is none.
        assert_eq!(row("cpu usage=3 0", &["throttle.angle"]), Ok(None));
        assert_eq!(row("cpu angle=3 0", &["throttle.angle"]), Ok(None));
    }

    #[test]
    fn faults_are_told() {
        for (line, wanted) in [
            ("", "no measurement"),
            ("m", "no `field=value`"),
            ("m,tag a=1 0", "no `field=value`"),
            ("m,tag", "a tag has no value"),
            ("m a=", "`` is no value"),
            ("m a=red 0", "`red` is no value"),
            ("m a=nan 0", "`nan` is no value"),
            ("m a=\"red 0", "a text has no end"),
            ("m a=1 soon", "`soon` is no timestamp"),
            ("m a=1", "no timestamp"),
            ("m a=\"1\" 0", "`a` is a text"),
        ] {
            let error = row(line, &["a"]).unwrap_err();
            assert!(error.contains(wanted), "{line}: {error}");
        }
    }

    #[test]
    fn other_formats_are_not_taken_for_it() {
        for text in ["t,u [V],x [m]", "t [ms],angle", "\"t\",\"a b=c\"", "0.1,2.0", "{\"t\": 1}", ""] {
            assert!(!is_influx(text), "{text}");
        }
        assert!(is_influx("m a=1 0") && is_influx("# comment"));
    }
}
