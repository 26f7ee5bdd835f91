//! Distribution of durations: counts per microsecond, percentiles on request.

const RANGE_US: usize = 5_000; // what is longer is counted as this long; the maximum is kept exactly

/// Counts per microsecond, and the maximum.
#[derive(Clone, Debug)]
pub struct LatencyHistogram {
    counts: Box<[u64; RANGE_US + 1]>,
    before: Box<[u64; RANGE_US + 1]>, // at the last look
    recent_maximum_us: u64,
    /// Durations since the start.
    pub count: u64,
    /// The longest of them, µs.
    pub maximum_us: u64,
}

/// What a distribution is published as, µs: the upper end of the bin that holds the rank.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Percentiles {
    /// 50, 90, 99 and 99.9 per cent.
    pub at: [f64; 4],
    /// The longest.
    pub maximum: f64,
}

const RANKS: [f64; 4] = [0.5, 0.9, 0.99, 0.999];

impl Default for LatencyHistogram {
    fn default() -> LatencyHistogram {
        let nothing = || Box::new([0; RANGE_US + 1]);
        LatencyHistogram {
            counts: nothing(),
            before: nothing(),
            recent_maximum_us: 0,
            count: 0,
            maximum_us: 0,
        }
    }
}

impl LatencyHistogram {
    /// Count one duration; a negative one, of a clock that was set, as none.
    pub fn add(&mut self, duration_ns: i64) {
        let us = (duration_ns.max(0) / 1000) as u64;
        self.counts[RANGE_US.min(us as usize)] += 1;
        self.count += 1;
        self.recent_maximum_us = self.recent_maximum_us.max(us);
        self.maximum_us = self.maximum_us.max(us);
    }

    /// Since the start; `None` before the first.
    #[must_use]
    pub fn total(&self) -> Option<Percentiles> {
        percentiles(|bin| self.counts[bin], self.maximum_us)
    }

    /// Since the last call; `None` where nothing was counted.
    pub fn recent(&mut self) -> Option<Percentiles> {
        let found = percentiles(|bin| self.counts[bin] - self.before[bin], self.recent_maximum_us);
        self.before.copy_from_slice(&self.counts[..]);
        self.recent_maximum_us = 0;
        found
    }
}

fn percentiles(counted: impl Fn(usize) -> u64, maximum_us: u64) -> Option<Percentiles> {
    let total: u64 = (0..=RANGE_US).map(&counted).sum();
    if total == 0 {
        return None;
    }
    let (mut at, mut next, mut below) = ([0.0; 4], 0, 0);
    for bin in 0..=RANGE_US {
        below += counted(bin);
        while next < RANKS.len() && below as f64 >= RANKS[next] * total as f64 {
            at[next] = (bin as u64 + 1).min(maximum_us + 1) as f64;
            next += 1;
        }
    }
    Some(Percentiles { at, maximum: maximum_us as f64 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_those_of_what_was_counted_since_the_last_look() {
        let mut histogram = LatencyHistogram::default();
        (1..=1000).for_each(|us| histogram.add(1000 * us));
        let found = histogram.recent().unwrap();
        assert_eq!(found.at, [501.0, 901.0, 991.0, 1000.0]);
        assert_eq!(found.maximum, 1000.0);
        assert_eq!(histogram.recent(), None);
        histogram.add(-7);
        histogram.add(i64::MAX);
        assert_eq!(histogram.recent().unwrap().at[0], 1.0);
        assert_eq!((histogram.count, histogram.maximum_us), (1002, i64::MAX as u64 / 1000));
    }
}
