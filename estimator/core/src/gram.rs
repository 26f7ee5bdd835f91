//! Sums of products of a balance's columns, and the linear algebra that every question to them is.
//!
//! A row z of [`crate::balance`] obeys z₀ = Σ xⱼ zⱼ + ε. Rows are summed into blocks G = Σ z zᵀ; blocks are
//! summed. Estimates, their covariance, the evidence of a sub-model and the misfit of a block follow from sums.

/// Columns of a row, the measured torque (column 0) included.
pub const COLUMNS: usize = 24;

/// One value a column.
pub type Row = [f64; COLUMNS];

/// A set of columns, one bit each.
pub type Set = u32;

const Z_95: f64 = 1.959_964; // two-sided 95 % of a normal distribution

/// COLUMNS, as a number that the compiler does not see: triangular loops stay loops.
///
/// Unrolled, 24 columns are 300 statements a loop, and a release build takes minutes.
fn all() -> usize {
    std::hint::black_box(COLUMNS)
}

/// Σ z zᵀ of rows: the lower triangle, and how many rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Gram {
    sums: [Row; COLUMNS],
    /// Number of rows.
    pub rows: f64,
}

impl Default for Gram {
    fn default() -> Gram {
        Gram { sums: [[0.0; COLUMNS]; COLUMNS], rows: 0.0 }
    }
}

impl Gram {
    /// Add one row.
    pub fn add_row(&mut self, row: &Row) {
        for i in 0..all() {
            for (sum, z) in self.sums[i][..=i].iter_mut().zip(row) {
                *sum += row[i] * z;
            }
        }
        self.rows += 1.0;
    }

    /// Add the rows of another one; with a weight of −1 they are left out again.
    pub fn add(&mut self, other: &Gram, weight: f64) {
        for i in 0..all() {
            for (sum, z) in self.sums[i][..=i].iter_mut().zip(&other.sums[i]) {
                *sum += weight * z;
            }
        }
        self.rows += weight * other.rows;
    }

    /// One entry.
    #[must_use]
    pub fn at(&self, i: usize, j: usize) -> f64 {
        self.sums[i.max(j)][i.min(j)]
    }

    /// Root mean square of one column.
    #[must_use]
    pub fn rms(&self, column: usize) -> f64 {
        (self.sums[column][column] / self.rows.max(1.0)).max(0.0).sqrt()
    }

    /// G c.
    #[must_use]
    pub fn times(&self, c: &Row) -> Row {
        let mut out = [0.0; COLUMNS];
        for i in 0..all() {
            let sums = &self.sums[i];
            for (j, sum) in sums[..i].iter().enumerate() {
                out[i] += sum * c[j];
                out[j] += sum * c[i];
            }
            out[i] += sums[i] * c[i];
        }
        out
    }

    /// cᵀ G c: with c = (1, −x) the sum of the squares that x leaves.
    #[must_use]
    pub fn quadratic(&self, c: &Row) -> f64 {
        self.times(c).iter().zip(c).map(|(a, b)| a * b).sum::<f64>().max(0.0)
    }
}

/// Gaussian prior of the coefficients, independent of each other.
#[derive(Clone, Copy, Debug)]
pub struct Prior {
    /// Expected values.
    pub mean: Row,
    /// Standard deviations, > 0.
    pub std: Row,
}

/// Maximum a posteriori coefficients of a set of columns, and what is known of them.
#[derive(Clone, Debug)]
pub struct Posterior {
    /// The columns with a coefficient.
    pub set: Set,
    /// (1, −x): the residual of a row is z · c.
    pub residual: Row,
    /// Inverse information, of the columns of the set.
    pub covariance: [Row; COLUMNS],
    /// ln of the marginal likelihood, but for what all sets have in common.
    pub log_evidence: f64,
}

impl Posterior {
    /// x of one column; 0 outside the set.
    #[must_use]
    pub fn coefficient(&self, column: usize) -> f64 {
        -self.residual[column]
    }

    /// gᵀ C g.
    #[must_use]
    pub fn variance_along(&self, g: &Row) -> f64 {
        let mut sum = 0.0;
        for i in (0..all()).filter(|i| g[*i] != 0.0) {
            sum += g[i] * self.covariance[i].iter().zip(g).map(|(v, b)| v * b).sum::<f64>();
        }
        sum.max(0.0)
    }

    /// Σ zᵀ C z over the rows of a block: the part of its misfit that uncertain coefficients explain.
    #[must_use]
    pub fn predicted(&self, block: &Gram) -> f64 {
        let mut sum = 0.0;
        for i in 0..all() {
            for j in (0..all()).filter(|j| self.covariance[i][*j] != 0.0) {
                sum += self.covariance[i][j] * block.at(i, j);
            }
        }
        sum
    }
}

/// The columns of a set, in order, and how many.
fn columns(set: Set) -> ([usize; COLUMNS], usize) {
    let (mut out, mut n) = ([0; COLUMNS], 0);
    for column in (1..COLUMNS).filter(|column| set >> column & 1 == 1) {
        out[n] = column;
        n += 1;
    }
    (out, n)
}

/// Posterior of the columns in `set`; `noise`: variance of a row times the rows that an independent one is worth.
///
/// `None`: a number is not finite. Columns are scaled by their diagonal before they are factorised.
#[must_use]
pub fn solve(gram: &Gram, set: Set, prior: &Prior, noise: f64) -> Option<Posterior> {
    let (index, n) = columns(set);
    let (mut a, mut b, mut scale) = ([[0.0; COLUMNS]; COLUMNS], [0.0; COLUMNS], [0.0; COLUMNS]);
    let mut log_prior = 0.0;
    let mut square = gram.at(0, 0) / noise;
    for i in 0..n {
        let (p, mean) = (prior.std[index[i]].powi(-2), prior.mean[index[i]]);
        for j in 0..=i {
            a[i][j] = gram.at(index[i], index[j]) / noise;
        }
        a[i][i] += p;
        b[i] = gram.at(index[i], 0) / noise + p * mean;
        log_prior += p.ln();
        square += p * mean * mean;
        scale[i] = a[i][i].sqrt().recip();
    }
    let mut log_determinant = 0.0;
    for i in 0..n {
        for j in 0..=i {
            a[i][j] *= scale[i] * scale[j];
        }
        b[i] *= scale[i];
        log_determinant -= 2.0 * scale[i].ln();
    }
    // Cholesky, in place; then the inverse of the factor, in place of a second one.
    let mut inverse = [[0.0; COLUMNS]; COLUMNS];
    for i in 0..n {
        for j in 0..=i {
            let rest: f64 = (0..j).map(|k| a[i][k] * a[j][k]).sum();
            let value = a[i][j] - rest;
            a[i][j] = if i == j { value.max(1e-14).sqrt() } else { value / a[j][j] };
        }
        log_determinant += 2.0 * a[i][i].ln();
        inverse[i][i] = a[i][i].recip();
        for j in 0..i {
            let rest: f64 = (j..i).map(|k| a[i][k] * inverse[k][j]).sum();
            inverse[i][j] = -rest / a[i][i];
        }
    }
    let mut covariance = [[0.0; COLUMNS]; COLUMNS];
    let (mut residual, mut gain) = ([0.0; COLUMNS], 0.0);
    residual[0] = 1.0;
    for i in 0..n {
        let mut x = 0.0;
        for j in 0..n {
            let c: f64 = (i.max(j)..n).map(|k| inverse[k][i] * inverse[k][j]).sum();
            x += c * b[j];
            covariance[index[i]][index[j]] = c * scale[i] * scale[j];
        }
        gain += x * b[i];
        residual[index[i]] = -x * scale[i];
    }
    let log_evidence = 0.5 * (log_prior - log_determinant - square + gain);
    let finite = log_evidence.is_finite() && residual.iter().all(|x| x.is_finite());
    finite.then_some(Posterior { set, residual, covariance, log_evidence })
}

/// The groups of columns that the evidence adds to a base, one after the other.
///
/// A group is added if it raises the evidence by more than the number of groups: the odds against each before
/// any data.
#[must_use]
pub fn choose(gram: &Gram, base: Set, groups: &[Set], prior: &Prior, noise: f64) -> Option<Posterior> {
    let threshold = (groups.len() as f64).ln();
    let mut best = solve(gram, base, prior, noise)?;
    loop {
        let mut next: Option<Posterior> = None;
        for group in groups.iter().filter(|group| *group & !best.set != 0) {
            let Some(tried) = solve(gram, best.set | group, prior, noise) else { continue };
            let above = next.as_ref().map_or(best.log_evidence + threshold, |next| next.log_evidence);
            if tried.log_evidence > above {
                next = Some(tried);
            }
        }
        let Some(found) = next else { return Some(best) };
        best = found;
    }
}

/// Replace the covariance by the one that is robust to correlation inside blocks.
///
/// A⁻¹ (n/(n−p) Σ s sᵀ + P) A⁻¹ with the blocks' scores s = G_b c over the noise, the prior's precision P, and
/// the factor of Student's t for as many blocks: correlation inside a block is in its score. Needs more blocks
/// than coefficients; returns whether there were.
pub fn cluster(posterior: &mut Posterior, blocks: &[Gram], prior: &Prior, noise: f64) -> bool {
    let (index, n) = columns(posterior.set);
    let freedom = blocks.len() as f64 - n as f64;
    if freedom < 2.0 {
        return false;
    }
    let correction = blocks.len() as f64 / freedom;
    let mut middle = [[0.0; COLUMNS]; COLUMNS];
    for block in blocks {
        let score = block.times(&posterior.residual);
        for &i in &index[..n] {
            for &j in &index[..n] {
                middle[i][j] += correction * score[i] * score[j] / (noise * noise);
            }
        }
    }
    for &i in &index[..n] {
        middle[i][i] += prior.std[i].powi(-2);
    }
    let wider = (student_95(freedom) / Z_95).powi(2);
    let bread = &posterior.covariance;
    let mut half = [[0.0; COLUMNS]; COLUMNS];
    for &i in &index[..n] {
        for &j in &index[..n] {
            half[i][j] = index[..n].iter().map(|&k| bread[i][k] * middle[k][j]).sum();
        }
    }
    let mut meat = [[0.0; COLUMNS]; COLUMNS];
    for &i in &index[..n] {
        for &j in &index[..n] {
            let sum: f64 = index[..n].iter().map(|&k| half[i][k] * bread[k][j]).sum();
            meat[i][j] = wider * sum;
        }
    }
    posterior.covariance = meat;
    true
}

/// How many times more the scores of the blocks vary than with independent rows, averaged over the columns.
#[must_use]
pub fn correlation(posterior: &Posterior, blocks: &[Gram], variance: f64) -> f64 {
    let (index, n) = columns(posterior.set);
    let (mut seen, mut independent) = ([0.0; COLUMNS], [0.0; COLUMNS]);
    for block in blocks {
        let score = block.times(&posterior.residual);
        for &i in &index[..n] {
            seen[i] += score[i] * score[i];
            independent[i] += variance * block.at(i, i);
        }
    }
    let ratio = |&i: &usize| seen[i] / independent[i].max(f64::MIN_POSITIVE);
    (index[..n].iter().map(ratio).sum::<f64>() / n.max(1) as f64).max(1.0)
}

/// Two-sided 95 % of Student's t, by Cornish and Fisher's series (within 1 % from three degrees of freedom on).
#[must_use]
pub fn student_95(freedom: f64) -> f64 {
    let (z, v) = (Z_95, freedom);
    let (z3, z5, z7) = (z.powi(3), z.powi(5), z.powi(7));
    z + (z3 + z) / (4.0 * v)
        + (5.0 * z5 + 16.0 * z3 + 3.0 * z) / (96.0 * v * v)
        + (3.0 * z7 + 19.0 * z5 + 17.0 * z3 - 15.0 * z) / (384.0 * v.powi(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reproducible numbers, uniform in (−1, 1).
    fn noise(seed: &mut u64) -> f64 {
        *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*seed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn rows(n: usize, x: [f64; 2], seed: u64, amplitude: f64) -> Vec<Row> {
        let mut seed = seed;
        (0..n)
            .map(|_| {
                let mut row = [0.0; COLUMNS];
                (row[1], row[2], row[3]) = (noise(&mut seed), 1e3 * noise(&mut seed), noise(&mut seed));
                row[0] = x[0] * row[1] + x[1] * row[2] + amplitude * noise(&mut seed);
                row
            })
            .collect()
    }

    fn sum(rows: &[Row]) -> Gram {
        let mut gram = Gram::default();
        rows.iter().for_each(|row| gram.add_row(row));
        gram
    }

    const WIDE: Prior = Prior { mean: [0.0; COLUMNS], std: [1e6; COLUMNS] };

    #[test]
    fn coefficients_are_those_of_dense_least_squares() {
        // Two columns: the normal equations in closed form.
        let rows = rows(400, [2.0, -0.03], 7, 0.1);
        let found = solve(&sum(&rows), 0b110, &WIDE, 1.0 / 300.0).unwrap();
        let dot = |a: usize, b: usize| rows.iter().map(|z| z[a] * z[b]).sum::<f64>();
        let determinant = dot(1, 1) * dot(2, 2) - dot(1, 2).powi(2);
        let first = (dot(2, 2) * dot(1, 0) - dot(1, 2) * dot(2, 0)) / determinant;
        let second = (dot(1, 1) * dot(2, 0) - dot(1, 2) * dot(1, 0)) / determinant;
        assert!((found.coefficient(1) - first).abs() < 1e-8 && (found.coefficient(2) - second).abs() < 1e-11);
        assert!((found.covariance[1][1] * determinant / dot(2, 2) * 300.0 - 1.0).abs() < 1e-6);
        let left: f64 = rows.iter().map(|z| (z[0] - first * z[1] - second * z[2]).powi(2)).sum();
        assert!((sum(&rows).quadratic(&found.residual) / left - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_block_that_is_left_out_was_never_there() {
        let rows = rows(300, [1.0, 1.0], 3, 0.5);
        let (mut all, part) = (sum(&rows), sum(&rows[100..]));
        all.add(&part, -1.0);
        let rest = sum(&rows[..100]);
        assert!((0..COLUMNS).all(|i| (all.at(i, 1) - rest.at(i, 1)).abs() < 1e-6));
        assert_eq!(all.rows, 100.0);
    }

    #[test]
    fn a_sharp_prior_holds_a_coefficient() {
        let mut prior = WIDE;
        (prior.mean[1], prior.std[1]) = (5.0, 1e-9);
        let found = solve(&sum(&rows(100, [2.0, 0.1], 5, 0.1)), 0b110, &prior, 0.003).unwrap();
        assert!((found.coefficient(1) - 5.0).abs() < 1e-6);
    }

    #[test]
    fn evidence_takes_the_column_that_acts_and_leaves_the_one_that_does_not() {
        let prior = Prior { mean: [0.0; COLUMNS], std: [1.0; COLUMNS] };
        let gram = sum(&rows(400, [2.0, -0.03], 7, 0.1));
        let found = choose(&gram, 0b10, &[0b100, 0b1000], &prior, 1.0 / 300.0).unwrap();
        assert_eq!(found.set, 0b110);
    }

    #[test]
    fn evidence_is_that_of_the_data_in_closed_form() {
        // One coefficient, one row: y ~ N(0, noise + z² s²), compared between two priors.
        let mut row = [0.0; COLUMNS];
        (row[0], row[1]) = (1.5, 2.0);
        let log = |s: f64| {
            let mut prior = WIDE;
            prior.std[1] = s;
            solve(&sum(&[row]), 0b10, &prior, 0.25).unwrap().log_evidence
        };
        let exact = |s: f64| {
            let v: f64 = 0.25 + 4.0 * s * s;
            -0.5 * (v / 0.25).ln() - 0.5 * 2.25 / v
        };
        assert!((log(0.5) - log(3.0) - exact(0.5) + exact(3.0)).abs() < 1e-9);
    }

    #[test]
    fn clustered_intervals_hold_correlated_errors_and_plain_ones_do_not() {
        // An error that is constant inside blocks of 20 rows beside a regressor that is, too.
        let (mut inside, mut plain, mut seed) = (0, 0, 11);
        for _ in 0..400 {
            let mut blocks = Vec::new();
            for _ in 0..40 {
                let (z, e) = (noise(&mut seed), noise(&mut seed));
                let mut row = [0.0; COLUMNS];
                (row[0], row[1]) = (3.0 * z + e, z);
                blocks.push(sum(&[row; 20]));
            }
            let mut total = Gram::default();
            blocks.iter().for_each(|block| total.add(block, 1.0));
            let mut found = solve(&total, 0b10, &WIDE, 1.0 / 3.0).unwrap();
            let off = (found.coefficient(1) - 3.0).abs();
            plain += i32::from(off < Z_95 * found.covariance[1][1].sqrt());
            assert!(cluster(&mut found, &blocks, &WIDE, 1.0 / 3.0));
            inside += i32::from(off < Z_95 * found.covariance[1][1].sqrt());
        }
        // 400 trials: one standard error of a share of 95 % is 1.1 %.
        assert!((367..=393).contains(&inside), "{inside}");
        assert!(plain < 250, "{plain}");
    }

    #[test]
    fn students_t_is_that_of_tables() {
        for (freedom, t) in [(3.0, 3.182), (5.0, 2.571), (10.0, 2.228), (30.0, 2.042)] {
            assert!((student_95(freedom) / t - 1.0).abs() < 0.012);
        }
    }
}
