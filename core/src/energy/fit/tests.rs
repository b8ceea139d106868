//! What rates follow from attempts whose rates are known.

use super::*;

/// Numbers from a seed, the same on every machine.
struct Draw(u64);

impl Draw {
    fn within(&mut self, least: u64, most: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        least + (self.0 >> 33) % (most - least + 1)
    }
    fn permille(&mut self, least: u64, most: u64) -> f64 {
        self.within(least, most) as f64 / 1_000.0
    }
}

/// A transport, an inspection or a way to a parking place, with what it takes a robot of these `times` the model's rates, give or take
/// `noise_permille`.
fn attempt(draw: &mut Draw, times: [f64; 4], noise_permille: u64) -> AttemptWork {
    let actions = draw.within(0, 2);
    let (empty_mm, loaded_mm) =
        (draw.within(5_000, 80_000), if actions == 2 { draw.within(10_000, 80_000) } else { 0 });
    let stands_ms = draw.within(0, 40_000);
    let duration_ms = empty_mm + loaded_mm + 4_000 * actions + stands_ms;
    let work = AttemptWork { empty_mm, loaded_mm, duration_ms, actions, energy_mwh: 0 };
    let noise = draw.permille(1_000 - noise_permille, 1_000 + noise_permille);
    AttemptWork { energy_mwh: (exact_mwh(&work, times) * noise).round() as u64, ..work }
}

fn exact_mwh(work: &AttemptWork, times: [f64; 4]) -> f64 {
    let parts = [
        work.empty_mm as f64 * 0.120,
        work.loaded_mm as f64 * 0.156,
        work.duration_ms as f64 * 80.0 / 3_600.0,
        work.actions as f64 * 500.0,
    ];
    parts.iter().zip(times).map(|(mwh, times)| mwh * times).sum()
}

fn times(robot: &RobotEnergy) -> [f64; 4] {
    let EnergyRates { empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh } = robot.rates;
    [
        f64::from(empty_mwh_per_km) / 120_000.0,
        f64::from(loaded_mwh_per_km) / 156_000.0,
        f64::from(idle_mw) / 80_000.0,
        f64::from(action_mwh) / 500.0,
    ]
}

fn sums(attempts: u64, mut work: impl FnMut() -> AttemptWork) -> EnergySums {
    let mut sums = EnergySums::default();
    (0..attempts).for_each(|_| {
        sums.add(&work());
    });
    sums
}

#[test]
fn rates_are_found_again_from_attempts_that_scatter_and_new_ones_lie_within_the_told_error() {
    for seed in 0..50 {
        let mut draw = Draw(seed);
        let truth: [f64; 4] = std::array::from_fn(|_| draw.permille(500, 3_000));
        let robot = fit(&sums(300, || attempt(&mut draw, truth, 50)));
        let error = f64::from(robot.error_permille.expect("it is fitted")) / 1_000.0;
        assert!((0.015..0.06).contains(&error), "seed {seed}: a twentieth either way was told as {error}");
        let ahead: Vec<AttemptWork> = (0..200).map(|_| attempt(&mut draw, truth, 50)).collect();
        let mean = ahead.iter().map(|work| work.energy_mwh as f64).sum::<f64>() / 200.0;
        for part in 0..4 {
            let mut off = [0.0; 4];
            off[part] = times(&robot)[part] - truth[part];
            let off = ahead.iter().map(|work| exact_mwh(work, off)).sum::<f64>() / 200.0 / mean;
            assert!(off.abs() < 0.03, "seed {seed}: {:?} for {truth:?}: {off} of an attempt", times(&robot));
        }
        let off = |work: &AttemptWork| (exact_mwh(work, times(&robot)) - work.energy_mwh as f64).powi(2);
        let root = (ahead.iter().map(off).sum::<f64>() / 200.0).sqrt() / mean;
        assert!(root < error * 1.25, "seed {seed}: new attempts are off by {root}, told {error}");
    }
}

#[test]
fn too_few_attempts_leave_the_figures_of_the_model() {
    let mut draw = Draw(1);
    let few = sums(ATTEMPTS_MIN - 1, || attempt(&mut draw, [2.0; 4], 0));
    let robot = fit(&few);
    assert_eq!((robot.rates, robot.error_permille, robot.attempts), (EnergyRates::MODEL, None, ATTEMPTS_MIN - 1));
}

#[test]
fn attempts_that_are_all_alike_change_the_sum_and_leave_its_parts_as_the_model_has_them() {
    let alike = AttemptWork { empty_mm: 30_000, loaded_mm: 30_000, duration_ms: 70_000, actions: 2, energy_mwh: 0 };
    let by = |times: f64| {
        let energy_mwh = exact_mwh(&alike, [times; 4]).round() as u64;
        fit(&sums(ATTEMPTS_MIN, || AttemptWork { energy_mwh, ..alike }))
    };
    assert!(times(&by(1.0)).iter().all(|times| (times - 1.0).abs() < 0.01), "{:?}", by(1.0));
    let half_more = by(1.5);
    let found = exact_mwh(&alike, times(&half_more)) / exact_mwh(&alike, [1.5; 4]);
    assert!((found - 1.0).abs() < 0.01, "{found}");
    assert!(times(&half_more).iter().all(|times| (1.0..2.2).contains(times)), "{half_more:?}");
    let nothing_done =
        fit(&sums(100, || AttemptWork { duration_ms: 60_000, energy_mwh: 2_667, ..AttemptWork::default() }));
    assert_eq!(times(&nothing_done)[..2], [1.0, 1.0], "a robot that never drove drives as the model says");
    assert!((times(&nothing_done)[2] - 2.0).abs() < 0.02);
}

#[test]
fn what_cannot_be_is_not_counted() {
    let real = AttemptWork { empty_mm: 50_000, loaded_mm: 20_000, duration_ms: 90_000, actions: 2, energy_mwh: 12_000 };
    let counts = |work: AttemptWork| EnergySums::default().add(&work);
    assert!(counts(real));
    let lies = [
        AttemptWork { energy_mwh: 0, ..real },
        AttemptWork { energy_mwh: 1_200, ..real },
        AttemptWork { energy_mwh: 121_300, ..real },
        AttemptWork { energy_mwh: u64::MAX, ..real },
        AttemptWork { energy_mwh: (-1_i64) as u64, ..real },
        AttemptWork { empty_mm: 900_000, energy_mwh: 120_000, ..real },
        AttemptWork { empty_mm: u64::MAX, loaded_mm: u64::MAX, ..real },
        AttemptWork { duration_ms: 0, ..real },
        AttemptWork { duration_ms: u64::MAX, ..real },
        AttemptWork { actions: 65, energy_mwh: 40_000, ..real },
    ];
    assert_eq!(lies.map(counts), [false; 10]);
}

#[test]
fn no_robot_moves_its_rates_beyond_their_bounds() {
    for (seed, least, most) in [(1, 9_000, 9_900), (2, 110, 130), (3, 110, 9_900)] {
        let mut draw = Draw(seed);
        let robot = fit(&sums(500, || {
            let times = draw.permille(least, most);
            attempt(&mut draw, [times; 4], 0)
        }));
        let within = |times: &f64| (TIMES_MIN - 0.001..=TIMES_MAX + 0.001).contains(times);
        assert!(robot.error_permille.is_some() && times(&robot).iter().all(within), "{robot:?}");
    }
}

#[test]
fn a_rate_that_would_lie_beyond_its_bound_is_put_there_and_the_others_explain_the_rest() {
    let mut draw = Draw(4);
    let robot = fit(&sums(400, || attempt(&mut draw, [1.0, 1.0, 0.0, 1.0], 20)));
    let [empty, loaded, idle, _] = times(&robot);
    assert_eq!(idle, TIMES_MIN);
    assert!(empty < 1.0 && loaded < 1.0, "less for the time means less for the way: {robot:?}");
}

#[test]
fn sums_of_the_largest_attempts_stay_far_from_their_end_and_the_newer_ones_weigh_more() {
    let largest = AttemptWork {
        empty_mm: 100_000_000,
        loaded_mm: 44_000_000,
        duration_ms: LONGEST.as_ms(),
        actions: ACTIONS_MAX,
        energy_mwh: CAPACITY_MWH as u64 * ABSURD_TIMES,
    };
    let mut long_lived = sums(10 * ATTEMPTS_MAX, || largest);
    assert!(long_lived.attempts < ATTEMPTS_MAX);
    assert!(long_lived.all_mut().all(|sum| *sum < u64::MAX / 16));
    let mut draw = Draw(5);
    let mut aged = sums(10 * ATTEMPTS_MAX, || attempt(&mut draw, [1.0; 4], 20));
    assert!(times(&fit(&aged)).iter().all(|times| (times - 1.0).abs() < 0.02));
    (0..3 * ATTEMPTS_MAX).for_each(|_| {
        aged.add(&attempt(&mut draw, [1.5; 4], 20));
    });
    assert!(times(&fit(&aged)).iter().all(|times| (times - 1.5).abs() < 0.05), "{:?}", fit(&aged));
}

#[test]
fn the_newest_software_is_taken_for_itself_once_it_has_done_enough() {
    let mut draw = Draw(6);
    let old = sums(200, || attempt(&mut draw, [1.0; 4], 10));
    let mut of_newest = |attempts| {
        let newest = sums(attempts, || attempt(&mut draw, [2.0; 4], 10));
        fit_robot(&newest, [&old, &newest].into_iter())
    };
    let young = of_newest(ATTEMPTS_OF_SOFTWARE - 1);
    assert_eq!(young.attempts, 200 + ATTEMPTS_OF_SOFTWARE - 1);
    assert!(times(&young)[0] < 1.5);
    let grown = of_newest(ATTEMPTS_OF_SOFTWARE);
    assert_eq!(grown.attempts, ATTEMPTS_OF_SOFTWARE);
    assert!(times(&grown).iter().all(|times| (times - 2.0).abs() < 0.25), "{grown:?}");
    assert!(young.error_permille > grown.error_permille, "two kinds of attempts scatter more than one");
}
