//! M z + h = 0 solved for the highest derivatives z, in symbols.

use greybox_model::Expr;

/// Most coordinates coupled through their inertias: Cramer's rule grows as their factorial.
pub(crate) const MOST_COUPLED: usize = 4;

fn zero(e: &Expr) -> bool {
    *e == Expr::Num(0.0)
}

/// Why not.
pub(crate) enum Unsolved {
    /// Unknowns whose matrix is structurally singular.
    Singular(Vec<usize>),
    /// Unknowns that are too many.
    Coupled(Vec<usize>),
}

/// Solves `mass` z = −`rest` for several right sides: `rest[i]` holds those of row i. Rows with a single unknown go
/// first, which is what actuators and memories of friction have; what is left is solved by Cramer's rule. The result
/// holds, for each unknown, one expression per right side; beside it stand the divisors, which must not vanish.
pub(crate) fn solve(
    mut mass: Vec<Vec<Expr>>,
    mut rest: Vec<Vec<Expr>>,
) -> Result<(Vec<Vec<Expr>>, Vec<Divisor>), Unsolved> {
    let n = mass.len();
    let sides = rest.first().map_or(0, Vec::len);
    let mut found: Vec<Option<Vec<Expr>>> = vec![None; n];
    let mut rows: Vec<usize> = (0..n).collect();
    let mut divisors = Vec::new();
    while let Some((at, j)) = rows.iter().enumerate().find_map(|(at, &i)| {
        let mut unknowns = (0..n).filter(|&j| !zero(&mass[i][j]));
        let first = unknowns.next()?;
        unknowns.next().is_none().then_some((at, first))
    }) {
        let i = rows.remove(at);
        divisors.push(Divisor { matrix: vec![vec![mass[i][j].clone()]], unknowns: vec![j] });
        let z: Vec<Expr> = rest[i].iter().map(|h| (-(h.clone() / mass[i][j].clone())).simplify()).collect();
        for &k in &rows {
            let m = std::mem::replace(&mut mass[k][j], Expr::Num(0.0));
            if !zero(&m) {
                for s in 0..sides {
                    rest[k][s] = (rest[k][s].clone() + m.clone() * z[s].clone()).simplify();
                }
            }
        }
        found[j] = Some(z);
    }
    let columns: Vec<usize> = (0..n).filter(|&j| found[j].is_none()).collect();
    if rows.len() != columns.len() || rows.iter().any(|&i| mass[i].iter().all(zero)) {
        return Err(Unsolved::Singular(columns));
    }
    if columns.len() > MOST_COUPLED {
        return Err(Unsolved::Coupled(columns));
    }
    if !columns.is_empty() {
        let matrix: Vec<Vec<Expr>> =
            rows.iter().map(|&i| columns.iter().map(|&j| mass[i][j].clone()).collect()).collect();
        let determinant = determinant(&matrix);
        if zero(&determinant) {
            return Err(Unsolved::Singular(columns));
        }
        for (c, &j) in columns.iter().enumerate() {
            let z = (0..sides).map(|s| {
                let mut replaced = matrix.clone();
                for (row, &i) in replaced.iter_mut().zip(&rows) {
                    row[c] = rest[i][s].clone();
                }
                (-(self::determinant(&replaced) / determinant.clone())).simplify()
            });
            found[j] = Some(z.collect());
        }
        divisors.push(Divisor { matrix, unknowns: columns.clone() });
    }
    let all: Option<Vec<Vec<Expr>>> = found.into_iter().collect();
    all.map(|z| (z, divisors)).ok_or(Unsolved::Singular(columns))
}

/// A block that was solved with.
pub(crate) struct Divisor {
    /// Its part of the mass matrix.
    pub(crate) matrix: Vec<Vec<Expr>>,
    /// The unknowns.
    pub(crate) unknowns: Vec<usize>,
}

/// By cofactors along the emptiest row.
fn determinant(m: &[Vec<Expr>]) -> Expr {
    let n = m.len();
    if n == 1 {
        return m[0][0].clone();
    }
    let filled = |i: &usize| m[*i].iter().filter(|e| !zero(e)).count();
    let row = (0..n).min_by_key(filled).unwrap_or(0);
    let mut sum = Expr::Num(0.0);
    for (j, entry) in m[row].iter().enumerate().filter(|(_, e)| !zero(e)) {
        let minor: Vec<Vec<Expr>> = (0..n)
            .filter(|&i| i != row)
            .map(|i| (0..n).filter(|&k| k != j).map(|k| m[i][k].clone()).collect())
            .collect();
        let product = entry.clone() * determinant(&minor);
        sum = if (row + j) % 2 == 0 { sum + product } else { sum - product };
    }
    sum.simplify()
}
