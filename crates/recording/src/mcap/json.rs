//! Messages in JSON: every number and truth value in them, by its path.

use super::fields::{Column, MOST, Row, bracket, is_names};
use serde_json::Value;
use std::collections::BTreeMap;

/// The numbers of a message and their names, and what is left out of it, with the reason.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    pub(super) row: Row,
    pub(super) columns: Vec<Column>,
    pub(super) left_out: BTreeMap<String, String>,
}

/// Reads the numbers of a message of `topic`.
///
/// # Errors
/// What is no JSON, in words.
pub(super) fn numbers(message: &[u8], topic: &str) -> Result<Numbers, String> {
    let value: Value = serde_json::from_slice(message).map_err(|e| format!("it is no JSON: {e}"))?;
    let stamp = value.get("header").and_then(|header| stamp(header.get("stamp")?));
    let mut found = Numbers { row: Row { stamp, ..Row::default() }, ..Numbers::default() };
    found.value(&value, topic.to_owned(), &mut Vec::new());
    for column in &found.columns {
        found.row.shape.extend(column.name.as_bytes());
        found.row.shape.push(0);
    }
    Ok(found)
}

/// A stamp as the bridges of ROS 2 (`sec`, `nanosec`) and ROS 1 (`secs`, `nsecs`) write it, ns.
fn stamp(value: &Value) -> Option<i64> {
    let whole = |names: [&str; 3]| names.iter().find_map(|name| value.get(name)?.as_i64());
    let seconds = whole(["sec", "secs", "seconds"])?;
    let rest = whole(["nanosec", "nsecs", "nsec"])?;
    seconds.checked_mul(1_000_000_000)?.checked_add(rest)
}

impl Numbers {
    fn value(&mut self, value: &Value, path: String, names: &mut Vec<Vec<String>>) {
        match value {
            Value::Null | Value::String(_) => {}
            Value::Bool(on) => self.put(f64::from(u8::from(*on)), path, true),
            Value::Number(number) => {
                if let Some(number) = number.as_f64() {
                    self.put(number, path, false);
                }
            }
            Value::Array(values) if values.len() > MOST => {
                self.left_out.insert(path, "long arrays".to_owned());
            }
            Value::Array(values) => {
                for (k, value) in values.iter().enumerate() {
                    let bracket = bracket(names, k, values.len());
                    self.value(value, format!("{path}{bracket}"), names);
                }
            }
            Value::Object(fields) => {
                let known = names.len();
                names.extend(fields.iter().filter(|(name, _)| is_names(name)).filter_map(|(_, list)| {
                    let list = list.as_array()?.iter().map(|text| text.as_str().map(str::to_owned));
                    list.collect::<Option<Vec<String>>>()
                }));
                for (name, value) in fields {
                    if name != "header" || value.get("stamp").is_none() {
                        self.value(value, format!("{path}.{name}"), names);
                    }
                }
                names.truncate(known);
            }
        }
    }

    fn put(&mut self, number: f64, name: String, held: bool) {
        self.row.numbers.push(number);
        self.columns.push(Column { name, unit: None, held });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> (Row, Vec<String>, BTreeMap<String, String>) {
        let Numbers { row, columns, left_out } = numbers(text.as_bytes(), "/t").unwrap();
        (row, columns.into_iter().map(|c| c.name).collect(), left_out)
    }

    #[test]
    fn numbers_are_called_by_their_paths() {
        let text = r#"{"a": 1.5, "on": true, "note": "x", "deep": {"list": [1, 2]}, "names": ["p", "q"], "v": [3, 4]}"#;
        let (row, names, _) = read(text);
        assert_eq!(names, ["/t.a", "/t.deep.list[p]", "/t.deep.list[q]", "/t.on", "/t.v[p]", "/t.v[q]"]);
        assert_eq!(row.numbers, [1.5, 1.0, 2.0, 1.0, 3.0, 4.0]);
        assert_eq!(row.stamp, None);
        assert_eq!(read("[7, {\"x\": 8}]").1, ["/t[0]", "/t[1].x"]);
        assert_eq!(read("2").1, ["/t"]);
    }

    #[test]
    fn stamps_are_times_and_long_lists_are_left_out() {
        let (row, names, _) = read(r#"{"header": {"stamp": {"sec": 5, "nanosec": 7}}, "a": 1}"#);
        assert_eq!((row.stamp, names), (Some(5_000_000_007), vec!["/t.a".to_owned()]));
        let (_, names, left_out) = read(&format!("{{\"a\": 1, \"scan\": {:?}}}", vec![0; MOST + 1]));
        assert_eq!((names.len(), left_out.len()), (1, 1));
        assert!(numbers(b"{\"a\": ", "/t").unwrap_err().contains("no JSON"));
    }
}
