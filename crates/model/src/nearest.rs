//! "Did you mean …": the nearest of a list of known names.

/// The candidate with the smallest edit distance to `wanted`, if it is near enough to be a slip of
/// the hand: at most one edit per three characters (at least one), ties to the first candidate.
///
/// ```
/// assert_eq!(greybox_model::nearest("thta", ["alpha", "theta"]), Some("theta"));
/// ```
pub fn nearest<'a>(wanted: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let allowed = (wanted.chars().count() / 3).max(1);
    let mut best: Option<(usize, &str)> = None;
    for candidate in candidates {
        let distance = edit_distance(wanted, candidate);
        // A one-letter name is one edit from every other one: only its other case is a hint.
        let too_short = wanted.chars().count() == 1 && !wanted.eq_ignore_ascii_case(candidate);
        if distance <= allowed && !too_short && best.is_none_or(|(d, _)| distance < d) {
            best = Some((distance, candidate));
        }
    }
    best.map(|(_, name)| name)
}

/// Optimal string alignment distance: insertions, deletions, substitutions and swaps of
/// neighbours each cost one; a change of case costs one as well.
fn edit_distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut before: Vec<usize> = Vec::new();
    let mut previous: Vec<usize> = (0..=b.len()).collect();
    for i in 1..=a.len() {
        let mut current = vec![i; b.len() + 1];
        for j in 1..=b.len() {
            let substitution = previous[j - 1] + usize::from(a[i - 1] != b[j - 1]);
            current[j] = substitution.min(previous[j] + 1).min(current[j - 1] + 1);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                current[j] = current[j].min(before[j - 2] + 1);
            }
        }
        before = std::mem::replace(&mut previous, current);
    }
    previous[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_slips_but_no_far_names() {
        assert_eq!(nearest("thta", ["alpha", "theta"]), Some("theta"));
        assert_eq!(nearest("isn", ["sin", "cos"]), Some("sin"));
        assert_eq!(nearest("j", ["J", "B"]), Some("J"));
        assert_eq!(nearest("x", ["y", "z"]), None);
        assert_eq!(nearest("velocity", ["theta", "alpha"]), None);
    }
}
