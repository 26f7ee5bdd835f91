//! From columns to unknowns.

use std::ops::{Index, IndexMut};

use serde::{Deserialize, Serialize};

use super::{COLUMNS, Gram, Matrix, PIVOT, Posterior, Row, Set, UNKNOWNS, Vector, dot, product, unknowns};

/// What each unknown adds to a row's balance, and what they explain together.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Frame {
    /// z · left is what is explained.
    #[serde(with = "crate::snapshot::array")]
    pub left: Row,
    /// z · d is what an unknown of 1 explains; index 0 is not used.
    #[serde(with = "crate::snapshot::rows")]
    pub directions: [Row; UNKNOWNS],
    /// The unknowns that have a direction.
    pub set: Set,
}

impl Frame {
    /// The residual of a row is z · c.
    #[must_use]
    pub fn residual(&self, x: &Vector, set: Set) -> Row {
        let mut c = self.left;
        for j in unknowns(set & self.set) {
            c.iter_mut().zip(&self.directions[j]).for_each(|(c, d)| *c -= x[j] * d);
        }
        c
    }

    /// rms of what some of the unknowns explain of the rows.
    #[must_use]
    pub fn rms(&self, gram: &Gram, known: &Posterior, of: Set) -> f64 {
        let mut c = [0.0; COLUMNS];
        for j in unknowns(of & known.set & self.set) {
            c.iter_mut().zip(&self.directions[j]).for_each(|(c, d)| *c += known.x[j] * d);
        }
        (gram.quadratic(&c) / gram.rows.max(1.0)).sqrt()
    }

    /// Dᵀ G D with `left` as the direction of index 0.
    #[must_use]
    pub fn reduce(&self, gram: &Gram) -> Reduced {
        Reduced { sums: self.sums(gram), noise: [[0.0; UNKNOWNS]; UNKNOWNS] }
    }

    /// The same, with the noise that is in the columns.
    #[must_use]
    pub fn reduce_noisy(&self, gram: &Gram, noise: &Gram) -> Reduced {
        Reduced { sums: self.sums(gram), noise: self.between(noise) }
    }

    /// What rounding leaves of a direction whose columns cancel is not of it: the sums stay positive definite.
    fn sums(&self, gram: &Gram) -> Matrix {
        let mut out = self.between(gram);
        for j in unknowns(self.set) {
            let size: f64 = (0..COLUMNS).map(|k| self.directions[j][k].abs() * gram.at(k, k).sqrt()).sum();
            out[j][j] += PIVOT * size * size;
        }
        out
    }

    fn between(&self, gram: &Gram) -> Matrix {
        let mut out = [[0.0; UNKNOWNS]; UNKNOWNS];
        for j in std::iter::once(0).chain(unknowns(self.set)) {
            let image = gram.times(if j == 0 { &self.left } else { &self.directions[j] });
            for i in std::iter::once(0).chain(unknowns(self.set)).filter(|i| *i <= j) {
                let value = dot(&image, if i == 0 { &self.left } else { &self.directions[i] });
                (out[i][j], out[j][i]) = (value, value);
            }
        }
        out
    }
}

/// Sums of products of the directions of the unknowns, with that of what they explain as index 0.
#[derive(Clone, Copy, Debug)]
pub struct Reduced {
    sums: Matrix,
    noise: Matrix, // of the columns alone
}

impl Reduced {
    /// What noise of the columns these unknowns leave in the rows.
    pub(super) fn left_noise(&self, x: &Vector, set: Set) -> f64 {
        let pull = self.pull(x, set);
        pull[0] - product(&pull, x)
    }

    /// Products of each column's noise with what of it these unknowns leave: least squares takes them for the rows' own.
    #[must_use]
    pub fn pull(&self, x: &Vector, set: Set) -> Vector {
        let mut with_left = *x;
        with_left[0] = -1.0;
        let mut out = [0.0; UNKNOWNS];
        std::iter::once(0).chain(unknowns(set)).for_each(|i| out[i] = -product(&self.noise[i], &with_left));
        out
    }
}

impl Index<usize> for Reduced {
    type Output = Vector;

    fn index(&self, i: usize) -> &Vector {
        &self.sums[i]
    }
}

impl IndexMut<usize> for Reduced {
    fn index_mut(&mut self, i: usize) -> &mut Vector {
        &mut self.sums[i]
    }
}
