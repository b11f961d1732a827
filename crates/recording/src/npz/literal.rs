//! The part of Python's literals that the head of an array is written in.

/// A value.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Literal {
    Text(String),
    Number(u64),
    Truth(bool),
    /// A list or a tuple.
    List(Vec<Literal>),
    Dictionary(Vec<(String, Literal)>),
}

/// Deepest nesting.
const MAX_DEPTH: usize = 16;

impl Literal {
    /// Reads one that takes up all of `text`, blanks aside.
    pub(super) fn parse(text: &str) -> Option<Literal> {
        let mut rest = text.trim_start();
        let value = value(&mut rest, 0)?;
        rest.trim().is_empty().then_some(value)
    }

    /// The value of a key.
    pub(super) fn get(&self, key: &str) -> Option<&Literal> {
        match self {
            Literal::Dictionary(entries) => {
                entries.iter().find(|(name, _)| name == key).map(|(_, value)| value)
            }
            _ => None,
        }
    }
}

fn value(rest: &mut &str, depth: usize) -> Option<Literal> {
    if depth > MAX_DEPTH {
        return None;
    }
    match rest.chars().next()? {
        '{' => {
            let mut entries = Vec::new();
            items(rest, '}', |rest| {
                let Literal::Text(key) = value(rest, depth + 1)? else { return None };
                skip(rest, ':')?;
                entries.push((key, value(rest, depth + 1)?));
                Some(())
            })?;
            Some(Literal::Dictionary(entries))
        }
        open @ ('(' | '[') => {
            let mut list = Vec::new();
            let close = if open == '(' { ')' } else { ']' };
            items(rest, close, |rest| {
                list.push(value(rest, depth + 1)?);
                Some(())
            })?;
            Some(Literal::List(list))
        }
        quote @ ('\'' | '"') => {
            let (text, after) = rest[1..].split_once(quote)?;
            *rest = after.trim_start();
            // None of NumPy's own heads has an escape.
            (!text.contains('\\')).then(|| Literal::Text(text.to_owned()))
        }
        '0'..='9' => {
            let end = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
            let number = rest[..end].parse().ok()?;
            // Python 2 wrote long numbers with an `L`.
            *rest = rest[end..].trim_start_matches('L').trim_start();
            Some(Literal::Number(number))
        }
        _ => {
            let (word, truth) =
                [("True", true), ("False", false)].into_iter().find(|(w, _)| rest.starts_with(w))?;
            *rest = rest[word.len()..].trim_start();
            Some(Literal::Truth(truth))
        }
    }
}

/// Items between brackets, of which the opening one stands first in `rest`, with commas between and perhaps behind.
fn items<'a>(
    rest: &mut &'a str,
    close: char,
    mut item: impl FnMut(&mut &'a str) -> Option<()>,
) -> Option<()> {
    *rest = rest[1..].trim_start();
    while !rest.starts_with(close) {
        item(rest)?;
        if !rest.starts_with(close) {
            skip(rest, ',')?;
        }
    }
    skip(rest, close)
}

fn skip(rest: &mut &str, character: char) -> Option<()> {
    *rest = rest.strip_prefix(character)?.trim_start();
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_of_arrays_are_read() {
        let head = Literal::parse(
            "{'descr': [('t', '<f8'), ('v', '<f4', (3,))], 'fortran_order': False, 'shape': (60, 2L), } ",
        );
        let head = head.unwrap();
        let text = |text: &str| Literal::Text(text.to_owned());
        let list = |list: &[Literal]| Literal::List(list.to_vec());
        assert_eq!(head.get("fortran_order"), Some(&Literal::Truth(false)));
        assert_eq!(head.get("shape"), Some(&list(&[Literal::Number(60), Literal::Number(2)])));
        let fields =
            [list(&[text("t"), text("<f8")]), list(&[text("v"), text("<f4"), list(&[Literal::Number(3)])])];
        assert_eq!(head.get("descr"), Some(&list(&fields)));
        assert_eq!(Literal::parse("()"), Some(list(&[])));
    }

    #[test]
    fn what_is_no_literal_is_none() {
        let deep = "(".repeat(100_000);
        for text in [
            "",
            "{",
            "{'a' 1}",
            "(1",
            "(1 2)",
            "'a",
            "1 2",
            "{1: 2}",
            "open('a')",
            "99999999999999999999",
            "é",
            &deep,
        ] {
            assert_eq!(Literal::parse(text), None, "{}", &text[..text.len().min(20)]);
        }
    }
}
