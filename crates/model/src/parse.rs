//! Lexer and Pratt parser of the model language.
//!
//! ```text
//! equation   = expression "=" expression
//! expression = expression ("+" | "-") expression
//!            | expression ("*" | "/") expression
//!            | "-" expression | "+" expression
//!            | expression "^" expression              right associative
//!            | number | name primes | function "(" expression {"," expression} ")"
//!            | "table" "(" expression "," "[" number {"," number} "]" "," "[" expression {"," expression} "]" ")"
//!            | "(" expression ")"
//! number     = digits ["." digits] [("e" | "E") ["+" | "-"] digits] | "." digits …
//! name       = letter {letter | digit | "_"}          letters of any alphabet
//! primes     = {"'"}                                  directly after the name
//! ```
//!
//! A minus sign binds looser than `*`, `/` and `^`, tighter than `+`: `-a*b` is −(a·b), `-x^2` is
//! −(x²), `x^-2` and `a/-b` mean what they look like. There is no implicit multiplication.

use crate::expr::{BinOp, Expr, Func};
use crate::nearest::nearest;
use crate::table::MAX_KNOTS;
use std::ops::Range;
use std::sync::Arc;

/// Deepest syntax tree that is accepted; every recursive walk over an [`Expr`] stays far inside the
/// smallest thread stack at this depth. Nested parentheses count, and so do the terms of one sum.
pub const MAX_DEPTH: usize = 400;

/// Deepest nesting of parentheses, function calls, signs and powers, as written and as printed.
const MAX_NESTING: usize = 100;

/// A parsed expression with the places of its parts in the text.
#[derive(Debug, Clone, PartialEq)]
pub struct Parsed {
    /// The syntax tree.
    pub expr: Expr,
    /// Every use of a name with its primes and its byte range, in the order of the text.
    pub names: Vec<(Arc<str>, u8, Range<usize>)>,
    /// The byte range of every node of `expr`, in post-order (children left to right, then the node).
    pub spans: Vec<Range<usize>>,
}

impl Parsed {
    /// The byte range of the first node that equals `wanted`.
    pub fn span_of(&self, wanted: &Expr) -> Option<Range<usize>> {
        fn find(e: &Expr, wanted: &Expr, next: &mut usize) -> Option<usize> {
            let found = match e {
                Expr::Num(_) | Expr::Var { .. } => None,
                Expr::Neg(a) => find(a, wanted, next),
                Expr::Bin(_, a, b) => find(a, wanted, next).or_else(|| find(b, wanted, next)),
                Expr::Call(_, args) => args.iter().find_map(|a| find(a, wanted, next)),
            };
            found.or_else(|| {
                *next += 1;
                (e == wanted).then_some(*next - 1)
            })
        }
        let index = find(&self.expr, wanted, &mut 0)?;
        self.spans.get(index).cloned()
    }
}

/// An equation `lhs = rhs`; ranges count from the start of the whole text.
#[derive(Debug, Clone, PartialEq)]
pub struct ParsedEquation {
    /// Left side.
    pub lhs: Parsed,
    /// Right side.
    pub rhs: Parsed,
}

/// Text that is not an expression of the model language.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}{}", .help.as_ref().map(|h| format!("; help: {h}")).unwrap_or_default())]
pub struct SyntaxError {
    /// Where, in bytes of the text (empty range at its end).
    pub span: Range<usize>,
    /// What was found and what was expected.
    pub message: String,
    /// How to fix it.
    pub help: Option<String>,
}

/// Parses one expression.
///
/// ```
/// use greybox_model::parse;
///
/// let parsed = parse("J*theta'' - ks*alpha")?;
/// assert_eq!(parsed.expr.to_string(), "J*theta'' - ks*alpha");
/// assert_eq!(parsed.names[1], ("theta".into(), 2, 2..9));
///
/// let error = parse("2theta").unwrap_err();
/// assert_eq!(error.help.as_deref(), Some("write `2*theta`"));
/// # Ok::<(), greybox_model::SyntaxError>(())
/// ```
///
/// # Errors
/// [`SyntaxError`] names what was found, what was expected, and the fix where one is likely.
pub fn parse(text: &str) -> Result<Parsed, SyntaxError> {
    let tokens = lex(text)?;
    if let Some(equals) = tokens.iter().find(|t| t.kind == Kind::Equals) {
        return Err(error(
            equals.span.clone(),
            "found `=`, expected an expression",
            Some("write the expression alone; only equations have an `=`".into()),
        ));
    }
    Parser::new(text, &tokens).whole()
}

/// Parses `lhs = rhs`.
///
/// # Errors
/// [`SyntaxError`], also for no `=`, several, or a side that is empty.
pub fn parse_equation(text: &str) -> Result<ParsedEquation, SyntaxError> {
    let tokens = lex(text)?;
    let mut signs = (0..tokens.len()).filter(|&i| tokens[i].kind == Kind::Equals);
    let Some(at) = signs.next() else {
        return Err(error(
            text.len()..text.len(),
            "an equation needs one `=`, found none",
            Some("end it with `= 0`, or write the right side".into()),
        ));
    };
    if let Some(second) = signs.next() {
        let doubled = tokens[at].span.end == tokens[second].span.start;
        let help = if doubled { "write a single `=`" } else { "write one equation per line" };
        return Err(error(
            tokens[second].span.clone(),
            "an equation needs one `=`, found another",
            Some(help.into()),
        ));
    }
    let mut left: Vec<Token> = tokens[..at].to_vec();
    left.push(Token { kind: Kind::End, span: tokens[at].span.start..tokens[at].span.start });
    for (side, first) in [("left", &left[0]), ("right", &tokens[at + 1])] {
        if first.kind == Kind::End {
            return Err(error(
                tokens[at].span.clone(),
                format!("the {side} side of the equation is empty"),
                Some("write `0` for it".into()),
            ));
        }
    }
    Ok(ParsedEquation {
        lhs: Parser::new(text, &left).whole()?,
        rhs: Parser::new(text, &tokens[at + 1..]).whole()?,
    })
}

fn too_nested(span: Range<usize>) -> SyntaxError {
    error(
        span,
        format!("the expression is nested deeper than {MAX_NESTING} levels"),
        Some("drop needless parentheses and signs, or split it".into()),
    )
}

fn error(span: Range<usize>, message: impl Into<String>, help: Option<String>) -> SyntaxError {
    SyntaxError { span, message: message.into(), help }
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Number(f64),
    /// The primes are part of the span.
    Name {
        primes: u8,
    },
    Op(BinOp),
    Open,
    Close,
    OpenList,
    CloseList,
    Comma,
    Equals,
    End,
}

#[derive(Debug, Clone, PartialEq)]
struct Token {
    kind: Kind,
    span: Range<usize>,
}

/// Splits `text` into tokens; the last one is [`Kind::End`].
fn lex(text: &str) -> Result<Vec<Token>, SyntaxError> {
    let mut tokens: Vec<Token> = Vec::new();
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let start = text.len() - rest.len();
        if c.is_whitespace() {
            rest = &rest[c.len_utf8()..];
            continue;
        }
        let (kind, length) = match c {
            '+' => (Kind::Op(BinOp::Add), 1),
            '-' => (Kind::Op(BinOp::Sub), 1),
            '*' if rest.starts_with("**") => {
                return Err(error(
                    start..start + 2,
                    "found `**`, expected an operator",
                    Some("a power is written `^`".into()),
                ));
            }
            '*' => (Kind::Op(BinOp::Mul), 1),
            '/' => (Kind::Op(BinOp::Div), 1),
            '^' => (Kind::Op(BinOp::Pow), 1),
            '(' => (Kind::Open, 1),
            ')' => (Kind::Close, 1),
            '[' => (Kind::OpenList, 1),
            ']' => (Kind::CloseList, 1),
            ',' => (Kind::Comma, 1),
            '=' => (Kind::Equals, 1),
            '0'..='9' | '.' => {
                let length = number_length(rest);
                let literal = &rest[..length];
                match literal.parse::<f64>() {
                    Ok(value) if value.is_finite() => (Kind::Number(value), length),
                    Ok(_) => {
                        return Err(error(
                            start..start + length,
                            format!("the number `{literal}` is too large"),
                            Some("numbers reach 1.7e308".into()),
                        ));
                    }
                    Err(_) => {
                        return Err(error(
                            start..start + length,
                            format!("found `{literal}`, expected a number"),
                            None,
                        ));
                    }
                }
            }
            _ if c.is_alphabetic() || c == '_' => {
                let letters = rest
                    .find(|c: char| !(c.is_alphabetic() || c.is_ascii_digit() || c == '_'))
                    .unwrap_or(rest.len());
                let primes = rest[letters..].bytes().take_while(|&b| b == b'\'').count();
                let Ok(count) = u8::try_from(primes) else {
                    return Err(error(
                        start + letters..start + letters + primes,
                        format!("{primes} primes after `{}`", &rest[..letters]),
                        Some("a coordinate has at most 255 derivatives".into()),
                    ));
                };
                (Kind::Name { primes: count }, letters + primes)
            }
            _ => return Err(stray(c, start, rest, text, tokens.last())),
        };
        tokens.push(Token { kind, span: start..start + length });
        rest = &rest[length..];
    }
    tokens.push(Token { kind: Kind::End, span: text.len()..text.len() });
    Ok(tokens)
}

/// Length in bytes of the number that `rest` starts with; an `e` counts only with digits after it.
fn number_length(rest: &str) -> usize {
    let bytes = rest.as_bytes();
    let digits =
        |from: usize| bytes[from.min(bytes.len())..].iter().take_while(|b| b.is_ascii_digit()).count();
    let mut length = digits(0);
    if bytes.get(length) == Some(&b'.') {
        length += 1 + digits(length + 1);
    }
    if matches!(bytes.get(length), Some(b'e' | b'E')) {
        let sign = usize::from(matches!(bytes.get(length + 1), Some(b'+' | b'-')));
        let exponent = digits(length + 1 + sign);
        if exponent > 0 {
            length += 1 + sign + exponent;
        }
    }
    length
}

/// The error for a character that starts no token.
fn stray(c: char, start: usize, rest: &str, text: &str, last: Option<&Token>) -> SyntaxError {
    let help = match c {
        '\'' => {
            let primes: String = rest.chars().take_while(|&c| c == '\'').collect();
            let span = start..start + primes.len();
            return match last {
                Some(Token { kind: Kind::Name { .. }, span: name }) => error(
                    span,
                    format!("found `{primes}` apart from its name"),
                    Some(format!("write `{}{primes}` without the space", &text[name.clone()])),
                ),
                Some(Token { kind: Kind::Close, .. }) => error(
                    span,
                    format!("found `{primes}` after `)`, expected an operator"),
                    Some(
                        "only names have primes: write the derivative out, as in `(x' + y')` for `(x + y)'`"
                            .into(),
                    ),
                ),
                _ => error(
                    span,
                    format!("found `{primes}`, expected a number, a name or `(`"),
                    Some("primes stand directly after a name, as in `theta''`".into()),
                ),
            };
        }
        '\u{2212}' | '\u{2013}' | '\u{2014}' | '\u{2010}' | '\u{2011}' => {
            "write the minus sign `-` of the keyboard"
        }
        '\u{b7}' | '\u{d7}' | '\u{22c5}' | '\u{2217}' | '\u{2219}' => "write `*`",
        '\u{f7}' | '\u{2215}' | '\u{2044}' => "write `/`",
        '\u{2032}' | '\u{2019}' | '\u{b4}' | '`' => "write the prime as `'`",
        '\u{2033}' | '"' => "write two primes as `''`",
        '\u{b2}' => "write `^2`",
        '\u{b3}' => "write `^3`",
        '{' => "write `(`",
        '}' => "write `)`",
        ';' => "arguments are separated by `,`; equations stand one per key",
        '<' | '>' | '!' | '&' | '?' => {
            "the language has no conditions; use `max`, `min`, `sign`, `deadzone` or `step`"
        }
        '|' => "write `abs(x)` for the absolute value",
        '%' => "write the fraction as a number",
        _ => "operators are `+ - * / ^`",
    };
    error(
        start..start + c.len_utf8(),
        format!("found `{c}`, which is no part of the language"),
        Some(help.into()),
    )
}

/// Binding powers: a left-associative operator parses its right operand one above its own.
const SUM: u8 = 1;
const PRODUCT: u8 = 3;
const POWER: u8 = 6;

struct Parser<'a> {
    text: &'a str,
    tokens: &'a [Token],
    position: usize,
    nesting: usize,
    /// The most that it was.
    deepest: usize,
    names: Vec<(Arc<str>, u8, Range<usize>)>,
    spans: Vec<Range<usize>>,
}

/// A subtree with its byte range and its depth.
struct Node {
    expr: Expr,
    span: Range<usize>,
    depth: usize,
}

impl<'a> Parser<'a> {
    /// `tokens` ends with [`Kind::End`].
    fn new(text: &'a str, tokens: &'a [Token]) -> Self {
        Parser { text, tokens, position: 0, nesting: 0, deepest: 0, names: Vec::new(), spans: Vec::new() }
    }

    /// Everything there is, which can be printed and read again: what is printed has a parenthesis around every sign
    /// that stands behind an operator or another sign.
    fn whole(mut self) -> Result<Parsed, SyntaxError> {
        let node = self.read()?;
        // A level of the text is printed as three at most.
        if self.deepest > MAX_NESTING / 3 {
            let printed = node.expr.to_string();
            let again = lex(&printed).and_then(|tokens| Parser::new(&printed, &tokens).read().map(drop));
            again.map_err(|_| too_nested(node.span))?;
        }
        Ok(Parsed { expr: node.expr, names: self.names, spans: self.spans })
    }

    fn read(&mut self) -> Result<Node, SyntaxError> {
        let node = self.expression(0)?;
        let token = self.peek();
        if token.kind != Kind::End {
            return Err(self.unexpected_after(&node));
        }
        Ok(node)
    }

    fn peek(&self) -> &'a Token {
        // `advance` never passes the End token, which is always there.
        &self.tokens[self.position]
    }

    fn advance(&mut self) -> &'a Token {
        let token = self.peek();
        if token.kind != Kind::End {
            self.position += 1;
        }
        token
    }

    /// Text of a token as it is shown in messages.
    fn shown(&self, token: &Token) -> String {
        match token.kind {
            Kind::End => "the end".into(),
            _ => format!("`{}`", &self.text[token.span.clone()]),
        }
    }

    fn node(&mut self, expr: Expr, span: Range<usize>, depth: usize) -> Result<Node, SyntaxError> {
        if depth > MAX_DEPTH {
            return Err(error(
                span,
                format!("the expression is deeper than {MAX_DEPTH} operations"),
                Some("group its terms with parentheses, or split it".into()),
            ));
        }
        self.spans.push(span.clone());
        Ok(Node { expr, span, depth })
    }

    /// An expression whose operators all bind at least as tight as `minimum`.
    fn expression(&mut self, minimum: u8) -> Result<Node, SyntaxError> {
        if self.nesting >= MAX_NESTING {
            return Err(too_nested(self.peek().span.clone()));
        }
        self.nesting += 1;
        self.deepest = self.deepest.max(self.nesting);
        let mut left = self.operand(minimum)?;
        while let Kind::Op(op) = self.peek().kind {
            let (own, right) = match op {
                BinOp::Add | BinOp::Sub => (SUM, SUM + 1),
                BinOp::Mul | BinOp::Div => (PRODUCT, PRODUCT + 1),
                BinOp::Pow => (POWER, POWER),
            };
            if own < minimum {
                break;
            }
            self.advance();
            let b = self.expression(right)?;
            let (span, depth) = (left.span.start..b.span.end, 1 + left.depth.max(b.depth));
            let expr = Expr::Bin(op, Box::new(left.expr), Box::new(b.expr));
            left = self.node(expr, span, depth)?;
        }
        self.nesting -= 1;
        Ok(left)
    }

    /// A number, a name, a call, a parenthesis, or one of these with a sign before it.
    fn operand(&mut self, minimum: u8) -> Result<Node, SyntaxError> {
        let token = self.advance();
        match token.kind {
            Kind::Number(value) => self.node(Expr::Num(value), token.span.clone(), 1),
            Kind::Name { primes } => self.name(token, primes),
            // `-a*b` is -(a*b), yet in `a/-b*c` the sign takes only `b`.
            Kind::Op(BinOp::Sub) => {
                let a = self.expression(minimum.max(PRODUCT))?;
                let span = token.span.start..a.span.end;
                if let Expr::Num(value) = a.expr {
                    self.spans.pop();
                    return self.node(Expr::Num(-value), span, 1);
                }
                self.node(Expr::Neg(Box::new(a.expr)), span, a.depth + 1)
            }
            Kind::Op(BinOp::Add) => self.expression(minimum.max(PRODUCT)),
            Kind::Open => {
                let inner = self.expression(0)?;
                let close = self.advance();
                if close.kind != Kind::Close {
                    return Err(self.unclosed(token, close, &inner));
                }
                // The range of a parenthesised node includes its parentheses.
                let span = token.span.start..close.span.end;
                if let Some(last) = self.spans.last_mut() {
                    *last = span.clone();
                }
                Ok(Node { span, ..inner })
            }
            Kind::Close if self.position >= 2 && self.tokens[self.position - 2].kind == Kind::Open => Err(
                error(token.span.clone(), "found `)`, expected an expression inside the parentheses", None),
            ),
            _ => {
                let found = self.shown(token);
                let help = match token.kind {
                    Kind::OpenList => NO_LIST,
                    _ => "write what is missing here, or remove the operator before it",
                };
                Err(error(
                    token.span.clone(),
                    format!("found {found}, expected a number, a name or `(`"),
                    Some(help.into()),
                ))
            }
        }
    }

    fn name(&mut self, token: &Token, primes: u8) -> Result<Node, SyntaxError> {
        let name = &self.text[token.span.start..token.span.end - usize::from(primes)];
        let function = Func::from_name(name);
        if self.peek().kind == Kind::Open {
            return match function {
                Some(f) if primes == 0 => self.call(f, token),
                Some(f) => Err(error(
                    token.span.clone(),
                    format!("the function `{}` has primes", f.name()),
                    Some("only names have primes: write the derivative out".into()),
                )),
                None => Err(error(token.span.clone(), format!("unknown function `{name}`"), {
                    let near = nearest(name, Func::ALL.iter().map(|f| f.name()));
                    let shown = &self.text[token.span.clone()];
                    Some(match near {
                        Some(near) => format!("did you mean `{near}`? A product is written `{shown}*(`"),
                        None => {
                            let all: Vec<&str> = Func::ALL.iter().map(|f| f.name()).collect();
                            format!("a product is written `{shown}*(`; functions are {}", all.join(" "))
                        }
                    })
                })),
            };
        }
        if let Some(f) = function {
            let found = self.shown(self.peek());
            return Err(error(
                token.span.clone(),
                format!("`{name}` is a function; found {found} after it, expected `(`"),
                Some(format!("write `{}`", usage(f))),
            ));
        }
        let name: Arc<str> = name.into();
        self.names.push((name.clone(), primes, token.span.clone()));
        self.node(Expr::Var { name, primes }, token.span.clone(), 1)
    }

    fn call(&mut self, f: Func, token: &Token) -> Result<Node, SyntaxError> {
        let open = self.advance();
        if f == Func::Table {
            return self.table(token, open);
        }
        let (mut args, mut depth) = (Vec::new(), 0);
        let close = if self.peek().kind == Kind::Close {
            self.advance()
        } else {
            loop {
                let arg = self.expression(0)?;
                depth = depth.max(arg.depth);
                let after = self.advance();
                match after.kind {
                    Kind::Comma | Kind::Close => args.push(arg.expr),
                    _ => return Err(self.unclosed(open, after, &arg)),
                }
                if after.kind == Kind::Close {
                    break after;
                }
            }
        };
        let span = token.span.start..close.span.end;
        if let Some(arity) = f.arity()
            && arity != args.len()
        {
            let plural = if arity == 1 { "argument" } else { "arguments" };
            return Err(error(
                span,
                format!("`{}` takes {arity} {plural}, found {}", f.name(), args.len()),
                Some(format!("write `{}`", usage(f))),
            ));
        }
        self.node(Expr::Call(f, args), span, depth + 1)
    }

    /// `x, [knots], [values])` of a table, after its `(`.
    fn table(&mut self, token: &Token, open: &Token) -> Result<Node, SyntaxError> {
        let x = self.expression(0)?;
        let after = self.advance();
        if after.kind != Kind::Comma {
            return Err(self.no_table(open, after));
        }
        let (first, knots) = self.list()?;
        let after = self.advance();
        if after.kind != Kind::Comma {
            return Err(self.no_table(open, after));
        }
        let (second, values) = self.list()?;
        let close = self.advance();
        if close.kind != Kind::Close {
            return Err(self.no_table(open, close));
        }
        let fault =
            |span: Range<usize>, message: String, help: &str| Err(error(span, message, Some(help.into())));
        if let Some(knot) = knots.iter().find(|k| !matches!(k.expr, Expr::Num(_))) {
            let found = &self.text[knot.span.clone()];
            let help = "divide the first argument by a parameter of its unit, and write the knots as fractions of it";
            return fault(knot.span.clone(), format!("found `{found}`, expected a knot: a number"), help);
        }
        let number = |k: &Node| if let Expr::Num(v) = k.expr { v } else { f64::NAN };
        if let Some(pair) = knots.windows(2).find(|pair| number(&pair[0]) >= number(&pair[1])) {
            let found = &self.text[pair[1].span.clone()];
            let message = format!("the knot `{found}` is not larger than the one before it");
            return fault(pair[1].span.clone(), message, "knots stand in increasing order, each once");
        }
        let n = knots.len();
        if !(2..=MAX_KNOTS).contains(&n) {
            let message = format!("a table has 2 to {MAX_KNOTS} knots, found {n}");
            return fault(first, message, "write the knots as `[k1, k2, …]`");
        }
        if n != values.len() {
            let message = format!("{n} knots, but {} values", values.len());
            return fault(second, message, "write one value for each knot");
        }
        let depth = knots.iter().chain(&values).fold(x.depth, |depth, e| depth.max(e.depth));
        let args: Vec<Expr> = std::iter::once(x).chain(knots).chain(values).map(|node| node.expr).collect();
        let span = token.span.start..close.span.end;
        if !Func::Table.takes(&args) {
            return fault(span, "the knots reach too far".into(), "their range has to stay below 1.7e308");
        }
        self.node(Expr::Call(Func::Table, args), span, depth + 1)
    }

    /// `[a, b, …]`, with the range of its text.
    fn list(&mut self) -> Result<(Range<usize>, Vec<Node>), SyntaxError> {
        let open = self.advance();
        if open.kind != Kind::OpenList {
            return Err(self.no_table(open, open));
        }
        let mut all = Vec::new();
        loop {
            let item = self.expression(0)?;
            let after = self.advance();
            match after.kind {
                Kind::Comma => all.push(item),
                Kind::CloseList => {
                    all.push(item);
                    return Ok((open.span.start..after.span.end, all));
                }
                Kind::End => {
                    let help = Some("add the missing `]`".into());
                    return Err(error(open.span.clone(), "this `[` is never closed", help));
                }
                _ => {
                    self.position -= 1;
                    return Err(self.unexpected_after(&item));
                }
            }
        }
    }

    /// The error for a `found` that is not what a table has there.
    fn no_table(&self, open: &Token, found: &Token) -> SyntaxError {
        if found.kind == Kind::End {
            return error(open.span.clone(), "this `(` is never closed", Some("add the missing `)`".into()));
        }
        let message = format!("found {}, which is not what a table has there", self.shown(found));
        error(found.span.clone(), message, Some(format!("write `{}`", usage(Func::Table))))
    }

    /// The error for `next` where the parenthesis `open` should close after `inner`.
    fn unclosed(&mut self, open: &Token, next: &Token, inner: &Node) -> SyntaxError {
        match next.kind {
            Kind::End => {
                error(open.span.clone(), "this `(` is never closed", Some("add the missing `)`".into()))
            }
            Kind::Comma => error(
                next.span.clone(),
                "found `,`, expected `)`",
                Some(
                    "a comma only separates the arguments of a function; decimals are written with `.`"
                        .into(),
                ),
            ),
            _ => {
                self.position -= 1;
                self.unexpected_after(inner)
            }
        }
    }

    /// The error for the next token, which cannot follow the complete expression `before`.
    fn unexpected_after(&self, before: &Node) -> SyntaxError {
        let token = self.peek();
        let found = self.shown(token);
        let help = match token.kind {
            Kind::Number(_) | Kind::Name { .. } | Kind::Open => {
                let previous = &self.tokens[self.position - 1];
                let left = match previous.kind {
                    Kind::Close => ")",
                    _ => &self.text[previous.span.clone()],
                };
                Some(format!("write `{left}*{}`", &self.text[token.span.clone()]))
            }
            Kind::Close => Some("remove it, or add the missing `(`".into()),
            Kind::OpenList => Some(NO_LIST.into()),
            Kind::CloseList => Some("remove it, or add the missing `[`".into()),
            Kind::Comma => Some("decimals are written with `.`".into()),
            _ => None,
        };
        let after = &self.text[before.span.clone()];
        let after = if after.chars().count() > 40 { String::new() } else { format!(" after `{after}`") };
        error(token.span.clone(), format!("found {found}{after}, expected an operator or the end"), help)
    }
}

const NO_LIST: &str = "write `(`; only a `table` has lists";

/// How a call of `f` is written.
fn usage(f: Func) -> String {
    let args = match f {
        Func::Delay => "x, tau",
        Func::Deadzone => "x, gap",
        Func::Saturate => "x, limit",
        Func::Step => "t, t0",
        Func::Min | Func::Max => "a, b",
        Func::Table => "x, [k1, k2], [v1, v2]",
        _ => "x",
    };
    format!("{}({args})", f.name())
}
