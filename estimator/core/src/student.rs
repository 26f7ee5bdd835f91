//! Student's t distribution: the tails of what is normal but for a variance that is known from few data.

/// |t| that a t distribution exceeds with this probability, from its tail integral by bisection.
#[must_use]
pub fn t_quantile(freedom: f64, probability: f64) -> f64 {
    // ∫ (1 + t²/ν)^(−(ν+1)/2) dt with t = √ν tan u is √ν ∫ cos^(ν−1) u du.
    let integral = |from: f64| {
        const STEPS: usize = 4000;
        let h = (std::f64::consts::FRAC_PI_2 - from) / STEPS as f64;
        (0..STEPS).map(|k| (from + (k as f64 + 0.5) * h).cos().powf(freedom - 1.0)).sum::<f64>() * h
    };
    let whole = integral(0.0);
    let (mut low, mut high) = (0.0, std::f64::consts::FRAC_PI_2);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if integral(middle) > probability.clamp(0.0, 1.0) * whole {
            low = middle;
        } else {
            high = middle;
        }
    }
    freedom.sqrt() * (0.5 * (low + high)).tan()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_tables() {
        assert!((t_quantile(20.0, 0.05) - 2.086).abs() < 1e-3);
        assert!((t_quantile(20.0, 0.001) - 3.850).abs() < 1e-3);
    }
}
