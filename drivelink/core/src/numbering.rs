//! Numbers the SYNCs of a log by later ones.
//!
//! Recorded stamps are often arrival times, which come in bursts. After a late SYNC others catch up; after a lost one
//! all stay behind.

use std::collections::VecDeque;

/// The stamp of a frame in a log without stamps.
const NO_STAMP: i64 = -1;
/// Later SYNCs used to number one.
pub const AHEAD: usize = 64;
/// Periods too early: a SYNC of another master.
const EXTRA: f64 = -0.5;
/// Of the deviation, per SYNC: the two clocks drift.
const FOLLOW: f64 = 0.05;

/// A SYNC that no later one is less late than.
struct Earliest {
    late_ns: i128,
    number: i64,
    stamp_ns: i64,
}

/// Numbers SYNCs once enough others have followed.
pub struct Numbering {
    period_ns: f64,
    last_ns: Option<i64>,
    due_ns: Option<f64>,
    stamps: VecDeque<i64>, // of the SYNCs that wait
    number: i64,           // of the first of them
    earliest: VecDeque<Earliest>,
}

impl Numbering {
    /// For SYNCs of this period.
    #[must_use]
    pub fn new(period_ns: f64) -> Numbering {
        let (stamps, earliest) = (VecDeque::new(), VecDeque::new());
        Numbering { period_ns, last_ns: None, due_ns: None, stamps, number: 0, earliest }
    }

    /// The stamps of the SYNCs that wait.
    #[must_use]
    pub fn stamps(&self) -> &VecDeque<i64> {
        &self.stamps
    }

    /// Add a SYNC.
    pub fn push(&mut self, stamp_ns: i64) {
        let number = self.number + self.stamps.len() as i64;
        let step_ns = self.period_ns.round_ties_even() as i128;
        let late_ns = i128::from(stamp_ns) - i128::from(number) * step_ns;
        while self.earliest.back().is_some_and(|last| last.late_ns > late_ns) {
            self.earliest.pop_back();
        }
        self.earliest.push_back(Earliest { late_ns, number, stamp_ns });
        self.stamps.push_back(stamp_ns);
    }

    /// Number the first SYNC that waits: periods since the one before, 0 if it was not due; `None`: none waits.
    pub fn pop(&mut self) -> Option<i64> {
        let stamp_ns = self.stamps.pop_front()?;
        let &Earliest { number, stamp_ns: first_ns, .. } = self.earliest.front()?;
        let ahead = (number - self.number) as f64; // SYNCs until that one
        if number == self.number {
            self.earliest.pop_front();
        }
        self.number += 1;
        if stamp_ns == NO_STAMP {
            return Some(1);
        }
        let last_ns = self.last_ns.replace(stamp_ns);
        let set_back = last_ns.is_some_and(|last| {
            i128::from(stamp_ns) < (last as f64 - self.period_ns).ceil() as i128 // the clock
        });
        let Some(due_ns) = self.due_ns.filter(|_| !set_back) else {
            self.due_ns = Some(first_ns as f64 - ahead * self.period_ns + self.period_ns);
            return Some(1);
        };
        let late = (stamp_ns as f64 - due_ns) / self.period_ns;
        if late < EXTRA {
            return Some(0);
        }
        let behind = ((first_ns as f64 - due_ns) / self.period_ns - ahead).round_ties_even();
        let lost = if late > 0.5 { behind.max(0.0) } else { 0.0 };
        let left = late - lost;
        let follow = if left.abs() < 0.5 { FOLLOW * left } else { 0.0 };
        self.due_ns = Some(due_ns + (1.0 + lost + follow) * self.period_ns);
        Some(1 + lost as i64)
    }

    /// Set the period in use; the SYNCs that wait begin anew with it.
    pub fn retime(&mut self, period_ns: f64) {
        self.period_ns = period_ns;
        self.earliest.clear();
        for stamp_ns in std::mem::take(&mut self.stamps) {
            self.push(stamp_ns);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jumps(stamps_ns: impl IntoIterator<Item = i64>) -> Vec<i64> {
        let mut numbering = Numbering::new(1e6);
        let mut found = Vec::new();
        for stamp_ns in stamps_ns {
            numbering.push(stamp_ns);
            found.extend((numbering.stamps().len() > AHEAD).then(|| numbering.pop()).flatten());
        }
        found.extend(std::iter::from_fn(|| numbering.pop()));
        found
    }

    #[test]
    fn a_burst_is_numbered_one_by_one_and_what_is_lost_is_a_gap() {
        let burst = (0..100).map(|k| if (20..26).contains(&k) { 26_000_000 } else { k * 1_000_000 });
        assert_eq!(jumps(burst), [1; 100]);
        let lost = (0..100).filter(|k| ![20, 21].contains(k)).map(|k| k * 1_000_000);
        assert_eq!(jumps(lost).iter().position(|&jump| jump != 1), Some(20));
    }

    #[test]
    fn one_too_many_is_not_due_and_a_clock_set_back_goes_on() {
        let every = |range: std::ops::Range<i64>| range.map(|k| k * 1_000_000);
        let extra = jumps(every(0..150).chain([149_200_000]).chain(every(150..300)));
        assert_eq!(extra.iter().enumerate().find(|(_, jump)| **jump != 1), Some((150, &0)));
        assert_eq!(jumps(every(100..200).chain(every(0..100))), [1; 200]);
        assert_eq!(jumps([NO_STAMP; 3]), [1; 3]);
    }
}
