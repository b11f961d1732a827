//! Expressions of the model language as a textbook prints them: `fc*sign(theta')` → fc·sign(θ′).
//!
//! Display only: the text is split into names, numbers and signs, never interpreted. Whatever it holds
//! comes out, escaped in the HTML form, so an expression that does not parse is still shown. Of a long list, such as the
//! knots of a table, the ends are shown.

use crate::format::superscript_char;

/// The expression as plain Unicode text, for labels and running text.
///
/// ```
/// use greybox_report::expression::text;
/// assert_eq!(text("fc*sign(theta')"), "fc·sign(θ′)");
/// assert_eq!(text("abs(x1 - x2)^2"), "|x₁ − x₂|²");
/// ```
pub fn text(expression: &str) -> String {
    render(expression, Style::Text)
}

/// The expression as HTML: names in `<var>`, indices in `<sub>`, exponents in `<sup>`, all else escaped.
pub fn html(expression: &str) -> String {
    render(expression, Style::Html)
}

/// A label such as `theta' [rad/s]` as plain text: the expression prettified, the unit set apart.
pub fn label(text_with_unit: &str) -> String {
    let trimmed = text_with_unit.trim();
    match trimmed.rsplit_once('[').and_then(|(head, tail)| Some((head, tail.strip_suffix(']')?))) {
        Some((head, unit)) if !head.trim().is_empty() => {
            format!("{} in {}", text(head.trim()), crate::format::unit(unit))
        }
        _ => text(trimmed),
    }
}

/// Escapes text for HTML content and double- or single-quoted attributes.
pub fn escape(raw: &str) -> String {
    let mut out = String::with_capacity(raw.len());
    for c in raw.chars() {
        push_escaped(&mut out, c);
    }
    out
}

fn push_escaped(out: &mut String, c: char) {
    match c {
        '&' => out.push_str("&amp;"),
        '<' => out.push_str("&lt;"),
        '>' => out.push_str("&gt;"),
        '"' => out.push_str("&quot;"),
        '\'' => out.push_str("&#39;"),
        other => out.push(other),
    }
}

/// Splits an expression (or any text) into names with their primes, numbers, blanks and single signs, for
/// token-wise comparison. The pieces joined give the text back.
pub fn tokens(source: &str) -> Vec<&str> {
    let mut out = Vec::new();
    let mut rest = source;
    while let Some(first) = rest.chars().next() {
        let length = if is_name_start(first) {
            let name = prefix(rest, |c| c.is_alphanumeric() || c == '_');
            name + prefix(&rest[name..], |c| c == '\'')
        } else if first.is_ascii_digit() || (first == '.' && starts_with_digit(&rest[1..])) {
            number_length(rest)
        } else if first.is_whitespace() {
            prefix(rest, char::is_whitespace)
        } else {
            first.len_utf8()
        };
        let (token, tail) = rest.split_at(length);
        out.push(token);
        rest = tail;
    }
    out
}

fn is_name_start(c: char) -> bool {
    c.is_alphabetic() || c == '_'
}

fn starts_with_digit(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_digit())
}

fn prefix(text: &str, accept: impl Fn(char) -> bool) -> usize {
    text.find(|c| !accept(c)).unwrap_or(text.len())
}

fn number_length(text: &str) -> usize {
    let mut length = prefix(text, |c| c.is_ascii_digit() || c == '.');
    let tail = &text[length..];
    if tail.starts_with(['e', 'E']) {
        let sign = usize::from(tail[1..].starts_with(['+', '-']));
        let digits = prefix(&tail[1 + sign..], |c| c.is_ascii_digit());
        if digits > 0 {
            length += 1 + sign + digits;
        }
    }
    length
}

#[derive(Clone, Copy, PartialEq)]
enum Style {
    Text,
    Html,
}

/// Most entries of a list in brackets that are all shown.
const LONGEST_LIST: usize = 6;

/// Leaves the first and the last entry of long lists, with an ellipsis between.
fn shorten_lists(pieces: &mut Vec<&str>, word_gap: &mut Vec<bool>) {
    let mut from = 0;
    while let Some(open) = pieces[from..].iter().position(|p| *p == "[").map(|at| from + at) {
        let Some(length) = pieces[open..].iter().position(|p| *p == "]") else { return };
        let commas: Vec<usize> = (open..open + length).filter(|i| pieces[*i] == ",").collect();
        if let (Some(first), Some(last)) = (commas.first(), commas.last())
            && commas.len() >= LONGEST_LIST
        {
            pieces.splice(first + 1..*last, ["…"]);
            word_gap.splice(first + 1..*last, [false]);
        }
        from = open + 1;
    }
}

fn render(expression: &str, style: Style) -> String {
    // Blanks are set anew around the operators; only between two words do they mean something.
    let mut pieces: Vec<&str> = Vec::new();
    let mut word_gap: Vec<bool> = Vec::new();
    let mut blank = false;
    for token in tokens(expression) {
        if token.trim().is_empty() {
            blank = true;
            continue;
        }
        pieces.push(token);
        word_gap.push(std::mem::take(&mut blank));
    }
    shorten_lists(&mut pieces, &mut word_gap);
    let mut out = String::new();
    // One entry per open parenthesis: true where it is the bar of an absolute value.
    let mut open: Vec<bool> = Vec::new();
    let mut operand_before = false;
    let mut index = 0;
    while index < pieces.len() {
        let token = pieces[index];
        let next = pieces.get(index + 1).copied().unwrap_or("");
        if word_gap[index] && operand_before && token.starts_with(|c: char| c.is_alphanumeric() || c == '_') {
            out.push(' ');
        }
        match token {
            "abs" if next == "(" => {
                out.push('|');
                open.push(true);
                index += 1;
                operand_before = false;
            }
            "(" => {
                out.push('(');
                open.push(false);
                operand_before = false;
            }
            ")" => {
                out.push(if open.pop() == Some(true) { '|' } else { ')' });
                operand_before = true;
            }
            "*" => {
                out.push('·');
                operand_before = false;
            }
            "," => {
                out.push_str(", ");
                operand_before = false;
            }
            "+" | "-" | "=" | "<" | ">" => {
                let sign = if token == "-" { '−' } else { token.chars().next().unwrap_or(' ') };
                if operand_before {
                    out.push(' ');
                }
                push_styled(&mut out, sign, style);
                if operand_before {
                    out.push(' ');
                }
                operand_before = false;
            }
            "^" if next.chars().all(|c| superscript_char(c).is_some()) && !matches!(next, "" | "-" | "+") => {
                push_exponent(&mut out, next, style);
                index += 1;
                operand_before = true;
            }
            _ if token.starts_with(is_name_start) => {
                push_name(&mut out, token, next == "(", style);
                operand_before = true;
            }
            _ => {
                for c in token.chars() {
                    push_styled(&mut out, c, style);
                }
                operand_before = token.starts_with(|c: char| c.is_ascii_digit() || c == '.');
            }
        }
        index += 1;
    }
    out
}

fn push_styled(out: &mut String, c: char, style: Style) {
    match style {
        Style::Text => out.push(c),
        Style::Html => push_escaped(out, c),
    }
}

fn push_exponent(out: &mut String, digits: &str, style: Style) {
    match style {
        Style::Text => out.extend(digits.chars().filter_map(superscript_char)),
        Style::Html => {
            out.push_str("<sup>");
            out.push_str(digits);
            out.push_str("</sup>");
        }
    }
}

/// A name with its primes: Greek letters by their spelling, what follows `_` or trailing digits as index.
fn push_name(out: &mut String, token: &str, is_function: bool, style: Style) {
    let name = token.trim_end_matches('\'');
    let primes = token.len() - name.len();
    if is_function && primes == 0 {
        out.push_str(&if style == Style::Html { escape(name) } else { name.to_owned() });
        return;
    }
    let (base, suffix) = name.split_once('_').filter(|(base, _)| !base.is_empty()).unwrap_or((name, ""));
    let letters = base.trim_end_matches(|c: char| c.is_ascii_digit());
    let (letters, digits) = if letters.is_empty() { (base, "") } else { base.split_at(letters.len()) };
    let shown = greek(letters).unwrap_or(letters);
    // A prime is set beside its letter, before any index.
    let marks = match primes {
        0 => String::new(),
        1 => "′".to_owned(),
        2 => "″".to_owned(),
        3 => "‴".to_owned(),
        n => "′".repeat(n),
    };
    match style {
        Style::Text => {
            out.push_str(shown);
            out.extend(digits.chars().filter_map(subscript_char));
            if !suffix.is_empty() {
                out.push('_');
                out.push_str(suffix);
            }
            out.push_str(&marks);
        }
        Style::Html => {
            out.push_str("<var>");
            out.push_str(&escape(shown));
            out.push_str("</var>");
            out.push_str(&marks);
            if !digits.is_empty() || !suffix.is_empty() {
                let comma = if digits.is_empty() || suffix.is_empty() { "" } else { "," };
                out.push_str("<sub>");
                out.push_str(&escape(&format!("{digits}{comma}{suffix}")));
                out.push_str("</sub>");
            }
        }
    }
}

fn subscript_char(c: char) -> Option<char> {
    let digit = c.to_digit(10)?;
    char::from_u32(0x2080 + digit)
}

fn greek(name: &str) -> Option<&'static str> {
    Some(match name {
        "alpha" => "α",
        "beta" => "β",
        "gamma" => "γ",
        "delta" => "δ",
        "epsilon" => "ε",
        "zeta" => "ζ",
        "eta" => "η",
        "theta" => "θ",
        "kappa" => "κ",
        "lambda" => "λ",
        "mu" => "μ",
        "nu" => "ν",
        "xi" => "ξ",
        "pi" => "π",
        "rho" => "ρ",
        "sigma" => "σ",
        "tau" => "τ",
        "phi" => "φ",
        "chi" => "χ",
        "psi" => "ψ",
        "omega" => "ω",
        "Gamma" => "Γ",
        "Delta" => "Δ",
        "Theta" => "Θ",
        "Lambda" => "Λ",
        "Sigma" => "Σ",
        "Phi" => "Φ",
        "Psi" => "Ψ",
        "Omega" => "Ω",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_like_a_textbook() {
        for (source, shown) in [
            ("fc*sign(theta')", "fc·sign(θ′)"),
            ("J*theta'' + B*theta' - ks*alpha = kt*v", "J·θ″ + B·θ′ − ks·α = kt·v"),
            ("-x+y", "−x + y"),
            ("a*(-x)", "a·(−x)"),
            ("(fc + (fs-fc)*exp(-(q'/vs)^2))*sign(q')", "(fc + (fs − fc)·exp(−(q′/vs)²))·sign(q′)"),
            ("theta_hub'", "θ_hub′"),
            ("1e-3*x1", "1e-3·x₁"),
            ("cd*q'*abs(q')", "cd·q′·|q′|"),
            ("delay(x, tau_f)", "delay(x, τ_f)"),
            ("x^n", "x^n"),
            ("hub torque 2", "hub torque 2"),
            ("table(x, [-1, 1], [a, b])", "table(x, [−1, 1], [a, b])"),
            (
                "table(x, [-3, -2, -1, 0, 1, 2, 3.5], [1, 2, 3, 4, 5, 6, -7])",
                "table(x, [−3, …, 3.5], [1, …, −7])",
            ),
            ("[1, 2, 3, 4, 5, 6, 7", "[1, 2, 3, 4, 5, 6, 7"),
            ("", ""),
        ] {
            assert_eq!(text(source), shown, "{source}");
        }
    }

    #[test]
    fn html_marks_names_and_escapes_the_rest() {
        assert_eq!(html("k*theta_hub'^2"), "<var>k</var>·<var>θ</var>′<sub>hub</sub><sup>2</sup>");
        assert_eq!(html("sign(x)"), "sign(<var>x</var>)");
        let hostile = html("<script>alert(1)</script>");
        assert!(!hostile.contains("<script"), "{hostile}");
        assert!(hostile.contains("&lt;"), "{hostile}");
    }

    #[test]
    fn tokens_lose_nothing() {
        for source in ["J*theta'' + 1.5e-3*x_1", "hub = \"a\" # ü ′", "....", "1e", "'''", "x\u{0301}²"] {
            assert_eq!(tokens(source).concat(), source);
        }
    }

    #[test]
    fn labels_set_the_unit_apart() {
        assert_eq!(label("theta' [rad/s]"), "θ′ in rad/s");
        assert_eq!(label("theta"), "θ");
        assert_eq!(label("[rad]"), "[rad]");
    }
}
