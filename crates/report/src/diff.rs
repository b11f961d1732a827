//! Comparison of two texts by their longest common subsequence.

/// One piece of a comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edit<T> {
    /// In both.
    Same(T),
    /// Only in the first.
    Removed(T),
    /// Only in the second.
    Added(T),
}

/// Most cells of the table of common subsequences; larger inputs are compared by their ends only.
const MAX_CELLS: usize = 4_000_000;

/// The shortest way from `a` to `b`; where something is replaced, the removal comes first.
///
/// Hunt–McIlroy in its plain form: L(i, j) = length of the longest common subsequence of `a[i..]` and
/// `b[j..]`, filled backwards, after stripping the common beginning and end. Models are tens of lines; for
/// inputs whose table would exceed four million cells the middle counts as replaced.
pub fn diff<'a, T: PartialEq + ?Sized>(a: &[&'a T], b: &[&'a T]) -> Vec<Edit<&'a T>> {
    let head = a.iter().zip(b).take_while(|(x, y)| x == y).count();
    let tail = a[head..].iter().rev().zip(b[head..].iter().rev()).take_while(|(x, y)| x == y).count();
    let (mid_a, mid_b) = (&a[head..a.len() - tail], &b[head..b.len() - tail]);
    let mut out: Vec<Edit<&T>> = a[..head].iter().map(|&x| Edit::Same(x)).collect();
    if mid_a.len().saturating_mul(mid_b.len()) > MAX_CELLS {
        out.extend(mid_a.iter().map(|&x| Edit::Removed(x)));
        out.extend(mid_b.iter().map(|&x| Edit::Added(x)));
    } else {
        middle(mid_a, mid_b, &mut out);
    }
    out.extend(a[a.len() - tail..].iter().map(|&x| Edit::Same(x)));
    out
}

fn middle<'a, T: PartialEq + ?Sized>(a: &[&'a T], b: &[&'a T], out: &mut Vec<Edit<&'a T>>) {
    let width = b.len() + 1;
    let mut common = vec![0u32; (a.len() + 1) * width];
    for i in (0..a.len()).rev() {
        for j in (0..b.len()).rev() {
            common[i * width + j] = if a[i] == b[j] {
                common[(i + 1) * width + j + 1] + 1
            } else {
                common[(i + 1) * width + j].max(common[i * width + j + 1])
            };
        }
    }
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        if i < a.len() && j < b.len() && a[i] == b[j] {
            out.push(Edit::Same(a[i]));
            (i, j) = (i + 1, j + 1);
        } else if i < a.len() && (j == b.len() || common[(i + 1) * width + j] >= common[i * width + j + 1]) {
            out.push(Edit::Removed(a[i]));
            i += 1;
        } else {
            out.push(Edit::Added(b[j]));
            j += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &str) -> Vec<&str> {
        text.lines().collect()
    }

    #[test]
    fn a_changed_and_an_added_line() {
        let edits = diff(&lines("a\nb\nc"), &lines("a\nB\nc\nd"));
        assert_eq!(
            edits,
            [Edit::Same("a"), Edit::Removed("b"), Edit::Added("B"), Edit::Same("c"), Edit::Added("d")]
        );
    }

    #[test]
    fn both_texts_can_be_read_back() {
        let (a, b) = (lines("x\ny\nz\nx\ny"), lines("y\nx\nq\nx\nz"));
        let edits = diff(&a, &b);
        let keep = |want_a: bool| -> Vec<&str> {
            edits
                .iter()
                .filter_map(|e| match *e {
                    Edit::Same(t) => Some(t),
                    Edit::Removed(t) => want_a.then_some(t),
                    Edit::Added(t) => (!want_a).then_some(t),
                })
                .collect()
        };
        assert_eq!(keep(true), a);
        assert_eq!(keep(false), b);
        assert!(diff::<str>(&[], &[]).is_empty());
    }
}
