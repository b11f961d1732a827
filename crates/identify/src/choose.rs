//! Choice of terms in a linear(ised) least-squares problem given by its triangular factor.

use greybox_calibrate::qr;

use crate::structure::Term;

/// min ‖z − R θ‖² + rest, the reduced form of a regression with `samples` rows.
#[derive(Debug, Clone)]
pub(crate) struct Reduced {
    /// Number of columns.
    pub columns: usize,
    /// Upper triangular factor, `columns × columns`, row major.
    pub r: Vec<f64>,
    /// Right-hand side, `columns`.
    pub z: Vec<f64>,
    /// Residual sum of squares with all columns.
    pub rest: f64,
    /// Effective number of rows.
    pub samples: f64,
    /// Mean square below which a misfit is numerical, in the units of the rows.
    pub floor: f64,
}

/// A least-squares solution on some of the columns.
#[derive(Debug, Clone)]
pub(crate) struct Solution {
    /// The columns used.
    pub columns: Vec<usize>,
    /// Their coefficients.
    pub values: Vec<f64>,
    /// Diagonal of (RᵀR)⁻¹.
    pub inverse: Vec<f64>,
    /// Residual sum of squares.
    pub rss: f64,
}

impl Reduced {
    /// From the triangular factor of \[columns | right-hand side\], `columns + 1` squared, row major.
    pub(crate) fn from_triangle(t: &[f64], columns: usize, samples: f64, floor: f64) -> Reduced {
        let stride = columns + 1;
        Reduced {
            columns,
            r: (0..columns * columns).map(|k| t[k / columns * stride + k % columns]).collect(),
            z: (0..columns).map(|i| t[i * stride + columns]).collect(),
            rest: t[columns * stride + columns].powi(2),
            samples,
            floor,
        }
    }

    /// The same with every row counting as `share` of one: sums shrink, the mean square stays as it is.
    pub(crate) fn weighted(mut self, share: f64) -> Reduced {
        self.r.iter_mut().chain(&mut self.z).for_each(|v| *v *= share.sqrt());
        self.rest *= share;
        self.samples *= share;
        self
    }

    /// Least squares on `columns`.
    pub(crate) fn solve(&self, columns: &[usize]) -> Solution {
        let (p, k) = (self.columns, columns.len());
        let mut a = vec![0.0; p * (k + 1)];
        let mut norm = vec![1.0; k];
        for (j, &c) in columns.iter().enumerate() {
            for i in 0..=c {
                a[j * p + i] = self.r[i * p + c];
            }
            let size = qr::dot(&a[j * p..(j + 1) * p], &a[j * p..(j + 1) * p]).sqrt();
            if size > 0.0 {
                norm[j] = size;
                a[j * p..(j + 1) * p].iter_mut().for_each(|v| *v /= size);
            }
        }
        a[k * p..].copy_from_slice(&self.z);
        let t = qr::triangle(&mut a, p, k + 1);
        let stride = k + 1;
        let rhs: Vec<f64> = (0..k).map(|i| t[i * stride + k]).collect();
        let mut values = qr::back_substitute(&t, stride, k, &rhs);
        let mut triangle = vec![0.0; k * k];
        for i in 0..k {
            triangle[i * k..(i + 1) * k].copy_from_slice(&t[i * stride..i * stride + k]);
        }
        let inv = qr::invert_triangle(&triangle, k);
        let inverse = (0..k)
            .map(|i| inv[i * k..(i + 1) * k].iter().map(|v| v * v).sum::<f64>() / (norm[i] * norm[i]))
            .collect();
        values.iter_mut().zip(&norm).for_each(|(v, n)| *v /= n);
        let corner = t.get(k * stride + k).copied().unwrap_or(0.0);
        Solution { columns: columns.to_vec(), values, inverse, rss: self.rest + corner * corner }
    }

    /// n ln(RSS/n + floor) + c k + surcharges + \[an even term is chosen\] · c_e, with k chosen optional
    /// terms. The floor keeps a noise-free record from paying for terms that only fix rounding.
    fn criterion(&self, solution: &Solution, penalty: &Penalty<'_>) -> f64 {
        let n = self.samples;
        let Roles { kept, even, surcharge, .. } = penalty.roles;
        let chosen = solution.columns.iter().filter(|c| !kept.contains(c)).count();
        let broken = solution.columns.iter().any(|c| even.contains(c));
        n * (solution.rss / n + self.floor).max(1e-300).ln()
            + penalty.term * chosen as f64
            + solution.columns.iter().filter_map(|c| surcharge.get(*c)).sum::<f64>()
            + if broken { BROKEN_SYMMETRY } else { 0.0 }
    }

    /// Squared t-statistics of the columns of a solution.
    pub(crate) fn t_squared(&self, solution: &Solution) -> Vec<f64> {
        let variance = (solution.rss / self.samples + self.floor).max(1e-300);
        solution
            .values
            .iter()
            .zip(&solution.inverse)
            .map(|(v, i)| v * v / (i * variance).max(1e-300))
            .collect()
    }

    /// The choice of terms: first with Schwarz's penalty ln n a term, then halfway from there to the penalty
    /// that the sizes of the terms found imply,
    ///
    /// ```text
    /// c = ½ ln n + ½ ln(1 + t²) at the lower quartile of |t|,   within   2 ln q ≤ c ≤ ln n + ln q .
    /// ```
    ///
    /// Schwarz's penalty takes one row's worth of information as prior, whatever the noise. ln(1 + t²) is what a
    /// normal prior as wide as the effects costs a coefficient (the empirical-Bayes g-prior of George & Foster,
    /// Biometrika 87, 2000; a quartile, because sizes spread over decades): where true terms stand a hundred
    /// standard errors clear of the noise, one at three is doubted; where they are barely visible, it is
    /// believed. Both limits pay for looking at q candidates: the lower is that of risk inflation (Foster & George,
    /// Ann. Statist. 22, 1994), the upper the extended Bayesian criterion with γ = ½ (Chen & Chen, Biometrika 95,
    /// 2008), for a choice is wrong as soon as one of q false terms is chosen.
    pub(crate) fn choose(&self, roles: &Roles) -> Solution {
        let schwarz = self.samples.ln();
        let looked_at = (roles.optional.len().max(2) as f64).ln();
        let (least, most) = (2.0 * looked_at, schwarz + looked_at);
        let mut solution = self.search(&Penalty { roles, term: schwarz });
        let mut penalty = schwarz;
        for _ in 0..4 {
            let mut sizes: Vec<f64> = self
                .t_squared(&solution)
                .into_iter()
                .zip(&solution.columns)
                .filter(|(_, c)| !roles.kept.contains(c))
                .map(|(t, _)| t.max(1e-12).ln())
                .collect();
            sizes.sort_by(f64::total_cmp);
            if sizes.is_empty() {
                break;
            }
            let at = 0.25 * (sizes.len() - 1) as f64;
            let (i, w) = (at.floor() as usize, at.fract());
            let quartile = sizes[i] + w * (sizes[(i + 1).min(sizes.len() - 1)] - sizes[i]);
            let implied = (1.0 + quartile.exp()).ln();
            let middle = (0.5 * (implied + schwarz)).max(least).min(most);
            if (middle - penalty).abs() < 1e-9 {
                break;
            }
            penalty = middle;
            solution = self.search(&Penalty { roles, term: penalty });
        }
        solution
    }

    /// The best choice found by backward elimination followed by single additions, removals and
    /// exchanges until none improves the criterion; from all terms and from the odd ones alone.
    fn search(&self, penalty: &Penalty<'_>) -> Solution {
        let Roles { optional, even, .. } = penalty.roles;
        let odd: Vec<usize> = optional.iter().copied().filter(|c| !even.contains(c)).collect();
        let all = self.search_from(optional, penalty);
        if odd.len() == optional.len() {
            return all;
        }
        let symmetric = self.search_from(&odd, penalty);
        if self.criterion(&symmetric, penalty) <= self.criterion(&all, penalty) { symmetric } else { all }
    }

    /// Backward from `start`, then locally among all optional columns.
    fn search_from(&self, start: &[usize], penalty: &Penalty<'_>) -> Solution {
        let Roles { kept, optional: allowed, .. } = penalty.roles;
        let value = |s: &Solution| self.criterion(s, penalty);
        let with = |columns: &mut Vec<usize>| {
            columns.sort_unstable();
            columns.dedup();
            self.solve(columns)
        };
        let mut best = with(&mut kept.iter().chain(start).copied().collect());
        let mut current = best.clone();
        loop {
            let worst = current
                .columns
                .iter()
                .enumerate()
                .filter(|(_, c)| !kept.contains(c))
                .map(|(i, _)| (i, current.values[i].powi(2) / current.inverse[i].max(1e-300)))
                .min_by(|a, b| a.1.total_cmp(&b.1));
            let Some((i, _)) = worst else { break };
            let mut columns = current.columns.clone();
            columns.remove(i);
            current = self.solve(&columns);
            if value(&current) <= value(&best) {
                best = current.clone();
            }
        }
        loop {
            let mut next: Option<Solution> = None;
            let mut offer = |s: Solution| {
                if value(&s) < next.as_ref().map_or(value(&best), &value) - 1e-9 {
                    next = Some(s);
                }
            };
            let outside: Vec<usize> = allowed.iter().copied().filter(|c| !best.columns.contains(c)).collect();
            let inside: Vec<usize> = best.columns.iter().copied().filter(|c| !kept.contains(c)).collect();
            for &c in &outside {
                let mut columns = best.columns.clone();
                columns.push(c);
                offer(with(&mut columns));
                for &d in &inside {
                    offer(with(&mut columns.iter().copied().filter(|&k| k != d).collect()));
                }
            }
            for &d in &inside {
                offer(with(&mut best.columns.iter().copied().filter(|&k| k != d).collect()));
            }
            match next {
                Some(s) => best = s,
                None => break,
            }
        }
        best
    }
}

/// What the first even term costs on top: −2 ln of the odds, one to ten, that a law of motion is not odd
/// (restoring forces and friction that differ between the two directions are the exception).
const BROKEN_SYMMETRY: f64 = 4.6;

/// What each degree beyond the third costs: −2 ln ½. Laws of motion seldom go beyond the cube, and among proxies
/// that data barely tell apart (x³ and x³ẋ²) the simpler is the better guess.
const HIGH_DEGREE: f64 = 1.39;

/// The parts that the columns of a regression play.
#[derive(Debug, Clone, Default)]
pub(crate) struct Roles {
    /// Always chosen.
    pub kept: Vec<usize>,
    /// To choose from.
    pub optional: Vec<usize>,
    /// Terms that keep their sign when all variables change theirs.
    pub even: Vec<usize>,
    /// What a column costs beyond the penalty of a term.
    pub surcharge: Vec<f64>,
}

impl Roles {
    /// The roles of columns that stand for candidates of `terms` (none: always kept), as far as `allowed`.
    pub(crate) fn new(columns: &[Option<usize>], terms: &[Term], allowed: &[bool]) -> Roles {
        let pick = |wanted: &dyn Fn(usize) -> bool| -> Vec<usize> {
            (0..columns.len()).filter(|&c| columns[c].is_some_and(wanted)).collect()
        };
        let mut kept = pick(&|t| !terms[t].optional);
        kept.extend((0..columns.len()).filter(|&c| columns[c].is_none()));
        let degree = |t: usize| terms[t].powers.iter().map(|p| p.1).sum::<u32>();
        Roles {
            kept,
            optional: pick(&|t| terms[t].optional && allowed[t]),
            even: pick(&|t| terms[t].even),
            surcharge: columns
                .iter()
                .map(|c| c.map_or(0.0, |t| HIGH_DEGREE * f64::from(degree(t).saturating_sub(3))))
                .collect(),
        }
    }
}

/// What a choice costs.
struct Penalty<'a> {
    roles: &'a Roles,
    /// A term.
    term: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Orthogonal unit columns with the given t-statistics under unit noise.
    fn orthogonal(t: &[f64], samples: f64, floor: f64) -> Reduced {
        let n = t.len();
        let mut r = vec![0.0; n * n];
        (0..n).for_each(|i| r[i * n + i] = 1.0);
        Reduced { columns: n, r, z: t.to_vec(), rest: samples, samples, floor }
    }

    fn roles(count: usize) -> Roles {
        Roles { optional: (0..count).collect(), surcharge: vec![0.0; count], ..Roles::default() }
    }

    #[test]
    fn on_orthogonal_columns_the_solution_is_the_right_hand_side() {
        let s = orthogonal(&[3.0, -2.0, 0.5], 100.0, 0.0).solve(&[0, 2]);
        assert_eq!(s.values, [3.0, 0.5]);
        assert!((s.rss - 104.0).abs() < 1e-12);
        assert!(s.inverse.iter().all(|v| (v - 1.0).abs() < 1e-12));
    }

    #[test]
    fn a_term_at_three_is_believed_among_its_likes_and_doubted_among_giants() {
        // 40 000 rows: Schwarz's penalty is 10.6, so t = 2.9 alone would never do.
        let chosen = |t: &[f64]| orthogonal(t, 40_000.0, 0.0).choose(&roles(t.len())).columns;
        assert_eq!(chosen(&[4.0, 3.9, 2.9, 0.3]), [0, 1, 2]);
        assert_eq!(chosen(&[900.0, 700.0, 800.0, 2.9]), [0, 1, 2]);
    }

    #[test]
    fn among_many_candidates_a_term_beside_giants_must_pay_more_than_schwarz_asks() {
        // ln 8000 = 9.0 < 3.2² = 10.2 < 11.1 < 3.5² = 12.3: halfway to what the giants imply, within ln 8000 + ln 50.
        let chosen = |weak: f64| {
            let mut t = vec![0.0; 50];
            t[..9].copy_from_slice(&[900.0, 700.0, 800.0, 750.0, 850.0, 950.0, 650.0, 720.0, weak]);
            orthogonal(&t, 8000.0, 0.0).choose(&roles(50)).columns.contains(&8)
        };
        assert!(!chosen(3.2) && chosen(3.5));
    }

    #[test]
    fn kept_columns_stay_and_even_terms_must_pay_for_the_symmetry_they_break() {
        let reduced = orthogonal(&[50.0, 3.4, 0.1], 1000.0, 0.0);
        let odd = Roles { kept: vec![2], optional: vec![0, 1], ..roles(3) };
        assert_eq!(reduced.choose(&odd).columns, [0, 1, 2]);
        let even = Roles { even: vec![1], ..odd };
        assert_eq!(reduced.choose(&even).columns, [0, 2]);
    }

    #[test]
    fn of_two_equal_proxies_the_one_of_lower_degree_is_taken() {
        // Two columns almost the same.
        let (c, s) = (0.999_f64, (1.0 - 0.999_f64.powi(2)).sqrt());
        let reduced = Reduced {
            columns: 2,
            r: vec![1.0, c, 0.0, s],
            z: vec![20.0, 0.3],
            rest: 1000.0,
            samples: 1000.0,
            floor: 0.0,
        };
        let penalty = |surcharge: Vec<f64>| Roles { surcharge, ..roles(2) };
        assert_eq!(reduced.choose(&penalty(vec![0.0, 2.0])).columns, [0]);
        assert_eq!(reduced.choose(&penalty(vec![2.0, 0.0])).columns, [1]);
    }

    #[test]
    fn what_only_fixes_rounding_is_left_out() {
        // Residuals of 10⁻⁷ where 10⁻⁵ counts as numerical: the third term is certain, and irrelevant.
        let mut reduced = orthogonal(&[30.0, 20.0, 1e-5], 1000.0, 1e-10);
        reduced.rest = 1000.0 * 1e-14;
        assert_eq!(reduced.choose(&roles(3)).columns, [0, 1]);
        reduced.floor = 0.0;
        assert_eq!(reduced.choose(&roles(3)).columns, [0, 1, 2]);
    }
}
