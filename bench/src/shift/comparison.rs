//! Holds one policy against another of the same run: the ratio of each seed, then their median with its spread.

use super::measures::Measures;
use crate::figure::Figure;
use std::collections::BTreeMap;

/// What is held against each other, as far as both have it.
const COMPARED: [&str; 8] = [
    "tasks",
    "empty travel",
    "completion, mean",
    "completion, p95",
    "wait for a robot, longest",
    "urgent completion, p95",
    "urgent wait for a robot, mean",
    "urgent wait for a robot, p95",
];

/// The shifts of one policy under one scenario.
pub struct Series {
    /// Name of the policy.
    pub policy: &'static str,
    /// Name of the scenario.
    pub scenario: &'static str,
    /// What is told of each seed.
    pub by_seed: BTreeMap<u64, Measures>,
}

/// Ratios of each policy to `fifo-nearest`, of `rolling` to `rolling-unaged`, and of W5 to its simple rule.
pub fn compare_all(played: &[Series]) -> Vec<Figure> {
    let pairs = played.iter().flat_map(|mine| played.iter().map(move |base| (mine, base)));
    pairs.filter_map(|(mine, base)| Some((mine, base, name_of_base(mine, base)?))).flat_map(compare).collect()
}

fn name_of_base(mine: &Series, base: &Series) -> Option<&'static str> {
    if mine.policy == base.policy {
        return (mine.scenario == "W5" && base.scenario == "W5 simple").then_some(base.scenario);
    }
    let is_base = base.policy == "fifo-nearest" || (mine.policy == "rolling" && base.policy == "rolling-unaged");
    (is_base && mine.scenario == base.scenario).then_some(base.policy)
}

fn compare((mine, base, name_of_base): (&Series, &Series, &str)) -> Vec<Figure> {
    let figure = |name: &&str| {
        let ratio = |(seed, measures): (&u64, &Measures)| {
            let of = base.by_seed.get(seed)?.find(name)?;
            Some(measures.find(name)? / of).filter(|ratio| ratio.is_finite())
        };
        let ratios: Vec<f64> = mine.by_seed.iter().filter_map(ratio).collect();
        let title = format!("{} {}: {name}, of {name_of_base}", mine.policy, mine.scenario);
        (!ratios.is_empty()).then(|| Figure::new("P7", title, "1", &ratios, None))
    };
    COMPARED.iter().filter_map(figure).collect()
}
