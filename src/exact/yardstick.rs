//! How good a policy is, measured against the best there is: one interface for all worlds.
//!
//! A [`Yardstick`] belongs to a world with its constants and a discount. It says what is best at any
//! budget, and compares any policy with it: the players of this program, or your own. What it needs to
//! know of a policy is its [`Evidence`]: a table of its action probabilities where the world is finite,
//! and laws of the return that were played elsewhere.
//!
//! | world | yardstick |
//! |---|---|
//! | of finitely many states | solved exactly, see [`super::finite`]; more in [`ExactYardstick`] |
//! | `lava-point` | the certified controller of [`super::oracle`], a lower bound of the optimum, and an upper bound |
//! | any other | none, unless its [`Solvable`] implementation has one |
//!
//! ```
//! use cvar_game::exact::table::TablePolicy;
//! use cvar_game::exact::yardstick::{Evidence, Options, Solvable};
//! use lava_envs::{GridConfig, LavaGrid};
//!
//! // A policy that moves at random (4 moves in 70 cells).
//! let policy = TablePolicy::stationary(70, 4, vec![0.25; 280]);
//! let grid = GridConfig::default();
//! let yardstick = LavaGrid::yardstick(&grid, 1.0, &Options::default())?.expect("it is finite");
//! let evidence = Evidence { policy: Some(&policy), ..Evidence::default() };
//! let found = yardstick.compare(25.0, &evidence)?.expect("a table is enough");
//! assert!(found.regret > 0.0);
//! # Ok::<(), cvar_game::exact::yardstick::YardstickError>(())
//! ```

use super::ExactError;
use super::antagonist::WorstCase;
use super::changes::{Changes, changes};
use super::finite::{ExactWorld, Exposure};
use super::law::evaluate;
use super::mdp::FiniteMdp;
use super::optimum::Optimum;
use super::oracle::upper_bound::UpperBound;
use super::oracle::{self, Bracket, Certified, Effort, OracleError};
use super::policy::Policy;
use super::require_eta;
use super::response::{self, Frozen, Response};
use super::stationary;
use super::table::TablePolicy;
use super::walk::Walk;
use super::watch::{Steps, Watch};
use crate::game::returns::ReturnLaw;
use lava_envs::law::{Law, sample_index};
use lava_envs::random::{Purpose, stream};
use lava_envs::{End, LavaGrid, LavaPoint, PointConfig, World};
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::sync::{Arc, Mutex};

/// A world whose optimum is known or can be computed.
pub trait Solvable: World {
    /// The yardstick of the world with these constants; gamma discounts per step. By default every
    /// finite world is solved exactly and any other one has no yardstick.
    ///
    /// # Errors
    /// If a constant or gamma is out of range, or the world is too large.
    fn yardstick(
        constants: &Self::Constants,
        gamma: f64,
        _options: &Options,
    ) -> Result<Option<Box<dyn Yardstick>>, YardstickError> {
        exactly::<Self>(constants, gamma)
    }
}

impl Solvable for LavaGrid {}

impl Solvable for lava_envs::Table {}

impl Solvable for LavaPoint {
    fn yardstick(
        constants: &PointConfig,
        gamma: f64,
        options: &Options,
    ) -> Result<Option<Box<dyn Yardstick>>, YardstickError> {
        let mut effort = Effort::of(constants);
        effort.lattice.cell = options.cell.unwrap_or(effort.lattice.cell);
        effort.lattice.velocity = options.velocity.unwrap_or(effort.lattice.velocity);
        let constants = constants.clone();
        let Options { source, upper_cell, .. } = *options;
        Ok(Some(Box::new(Oracle { constants, gamma, effort, source, upper_cell })))
    }
}

/// The exact yardstick of a world; `None` if it is not finite.
///
/// # Errors
/// If a constant or gamma is out of range, or the world is too large.
pub fn exactly<W: World>(
    constants: &W::Constants,
    gamma: f64,
) -> Result<Option<Box<dyn Yardstick>>, YardstickError> {
    match ExactWorld::<W>::new(constants, gamma) {
        Ok(world) => Ok(Some(Box::new(Exact {
            world,
            solved: Mutex::default(),
            stationary: Mutex::default(),
        }))),
        Err(ExactError::NotFinite(_)) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// How a yardstick is computed, where that takes long.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Options {
    /// Where its certificates come from.
    pub source: Source,
    /// Distance of the lattice's positions, in m; the oracle's default if `None`.
    pub cell: Option<f64>,
    /// Distance of the lattice's velocities, in m/s; the oracle's default if `None`.
    pub velocity: Option<f64>,
    /// Side of the cells of the upper bound, in m; that of the bound that comes with the program, or the default, if
    /// `None`.
    pub upper_cell: Option<f64>,
}

/// Where certificates come from. Exact solutions take milliseconds and are always computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Source {
    /// Only those that come with the program; there is none for other constants.
    Shipped,
    /// Those that come with the program, then the user's cache; others are computed and kept there.
    #[default]
    Computed,
    /// Computed though they may be known, and kept in the cache.
    Anew,
}

/// Why a yardstick cannot be had or used.
#[derive(Debug, thiserror::Error)]
pub enum YardstickError {
    /// From an exact solution.
    #[error(transparent)]
    Exact(#[from] ExactError),
    /// From the oracle.
    #[error(transparent)]
    Oracle(#[from] OracleError),
}

/// What is known of a policy that is to be measured.
#[derive(Debug, Clone, Copy, Default)]
pub struct Evidence<'a> {
    /// The probabilities of its actions, on a finite world. Its greedy version takes the likeliest
    /// action.
    pub policy: Option<&'a TablePolicy>,
    /// The law of the greedy policy's return under nominal chance, from recorded episodes.
    pub nominal: Option<&'a ReturnLaw>,
    /// The law of the greedy policy's return against its antagonist, from recorded episodes; `None`
    /// where it has none.
    pub opposed: Option<&'a ReturnLaw>,
    /// The best response to its antagonist, from [`ExactYardstick::best_response`]; at eta = 1, where no
    /// antagonist can do anything, it need not be given.
    pub response: Option<Response>,
}

/// A policy compared with the best.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    /// The best CVaR_{1/eta}(J) there is or, for an oracle, that is certified.
    pub optimum: f64,
    /// The optimum minus CVaR_{1/eta} of the greedy policy; negative where it is better than an
    /// oracle.
    pub regret: f64,
    /// Standard error of `regret`; 0 where that is exact.
    pub regret_standard_error: f64,
    /// Mean return of the greedy policy against its antagonist, minus its CVaR_{1/eta}; 0 where it has
    /// none.
    pub antagonist_gap: f64,
    /// Standard error of `antagonist_gap`.
    pub antagonist_gap_standard_error: f64,
    /// The best CVaR_{1/eta} that is found for a stationary deterministic policy
    /// ([`super::stationary`]) minus that of the greedy policy, where that does not see the time. The best one
    /// there is may be better than the best one found, and so may the policy: then this is negative.
    pub class_regret: Option<f64>,
    /// How far the policy and its antagonist are from an equilibrium; `None` where the best response to the
    /// antagonist is not known.
    pub exploitability: Option<Exploitability>,
}

impl Comparison {
    /// A policy of which only recorded episodes are known, compared with an optimum of a standard error; `None`
    /// if there are no such episodes.
    fn of_episodes(
        eta: f64,
        (optimum, optimum_error): (f64, f64),
        evidence: &Evidence<'_>,
    ) -> Option<Self> {
        let alpha = 1.0 / eta;
        let nominal = evidence.nominal?;
        let (cvar, error) = (nominal.cvar(alpha), nominal.cvar_standard_error(alpha));
        let (antagonist_gap, antagonist_gap_standard_error) = evidence
            .opposed
            .map_or((0.0, 0.0), |law| (law.mean() - cvar, law.mean_standard_error().hypot(error)));
        Some(Comparison {
            optimum,
            regret: optimum - cvar,
            regret_standard_error: error.hypot(optimum_error),
            antagonist_gap,
            antagonist_gap_standard_error,
            class_regret: None,
            exploitability: None,
        })
    }
}

/// How much the better deviation of one player improves on V*(eta), in the sense of the paper's Definition 2:
///
///   epsilon = max(V* - CVaR_{1/eta} of the greedy policy, best response to the antagonist - V*).
///
/// The first half is the regret: the least mean return of a deterministic policy over all antagonists is its
/// CVaR_{1/eta}. The second half is an upper bound, because the best response may see the remaining budget.
/// Neither is negative up to rounding and, for the second, `response_error`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Exploitability {
    /// The larger half.
    pub epsilon: f64,
    /// The second half: what the best response to the antagonist gains over V*(eta).
    pub response_gain: f64,
    /// Estimate of the numerical error of `response_gain`.
    pub response_error: f64,
}

impl Exploitability {
    fn new(optimum: f64, regret: f64, response: Response) -> Self {
        let response_gain = response.value - optimum;
        let epsilon = regret.max(response_gain);
        Exploitability { epsilon, response_gain, response_error: response.error }
    }
}

/// The answer to a question: a page for people by [`Display`], JSON for programs.
pub trait Answer: Display {
    /// The answer as JSON on one line.
    fn json(&self) -> String;
}

impl<T: Display + Serialize> Answer for T {
    fn json(&self) -> String {
        serde_json::to_string(self).expect("numbers and words have a JSON form")
    }
}

/// What is best in a world, and how far from it a policy is. Budgets eta are finite numbers of at
/// least 1.
pub trait Yardstick: Send + Sync {
    /// All that is known of the optimum at a budget; `None` where nothing is. `watch` is told how far it is,
    /// where that takes minutes.
    ///
    /// # Errors
    /// If the budget is out of range, or the optimum cannot be computed.
    fn answer(
        &self,
        eta: f64,
        watch: &dyn Watch,
    ) -> Result<Option<Box<dyn Answer>>, YardstickError>;

    /// The law of the return of a policy that is optimal at a budget, for its mean and for its CVaR at
    /// any level; `None` where no such policy is known.
    ///
    /// # Errors
    /// If the budget is out of range, or the optimum cannot be computed.
    fn optimal_law(&self, eta: f64) -> Result<Option<ReturnLaw>, YardstickError>;

    /// Episodes of a policy that is optimal at a budget, or the best known, on the streams of an evaluation with this seed,
    /// from the first on: so many, or fewer, or none where they are not at hand.
    ///
    /// # Errors
    /// If the budget is out of range, or the optimum cannot be computed.
    fn walks(&self, eta: f64, seed: u64, count: u64) -> Result<Vec<Walk>, YardstickError>;

    /// Compares a policy with the best at a budget; `None` where the optimum is not known or the
    /// evidence does not say enough.
    ///
    /// # Errors
    /// If the budget or the policy is out of range, or the optimum cannot be computed.
    fn compare(
        &self,
        eta: f64,
        evidence: &Evidence<'_>,
    ) -> Result<Option<Comparison>, YardstickError>;

    /// What can be said without sampling error; `None` where the world is not finite.
    fn exact(&self) -> Option<&dyn ExactYardstick> {
        None
    }
}

/// What can be said without sampling error of any policy that is a table.
pub trait ExactYardstick: Send + Sync {
    /// The laws of the return of the greedy and of the sampled policy under nominal chance.
    ///
    /// # Errors
    /// If the policy does not fit the world.
    fn laws(&self, policy: &TablePolicy) -> Result<Laws, ExactError>;

    /// V*(eta) - CVaR_{1/eta} of the greedy policy. The optimum is solved once for each budget, so
    /// that this may be asked after every update of training.
    ///
    /// # Errors
    /// If the budget is out of range or the policy does not fit the world.
    fn regret(&self, eta: f64, policy: &TablePolicy) -> Result<f64, ExactError>;

    /// The best response to an antagonist that no longer learns, whose budget is eta. `None` if the antagonist
    /// does not give its ratios or the world is too large ([`response::best_response`]).
    ///
    /// # Errors
    /// If the budget is out of range.
    fn best_response(
        &self,
        eta: f64,
        antagonist: &mut dyn Frozen,
    ) -> Result<Option<Response>, ExactError>;

    /// The exact worst-case antagonist of the greedy policy, to play against.
    ///
    /// # Errors
    /// If the budget is out of range, the policy does not fit the world, or the antagonist must know
    /// more than time and state ([`ExactError::Levels`]).
    fn worst_case(
        &self,
        eta: f64,
        policy: &TablePolicy,
    ) -> Result<Box<dyn Ratios + '_>, ExactError>;

    /// What the greedy policy meets under its worst-case antagonist at a budget above 1.
    ///
    /// # Errors
    /// If the budget is out of range or the policy does not fit the world.
    fn exposure(&self, eta: f64, policy: &TablePolicy) -> Result<Exposure, ExactError>;

    /// What single changes of the greedy policy are worth at a budget.
    ///
    /// # Errors
    /// If the budget is out of range or the policy does not fit the world.
    fn changes(&self, eta: f64, policy: &TablePolicy) -> Result<Changes, ExactError>;

    /// Expected visits of each state by the greedy policy, ends included, when every action is carried
    /// out as it was chosen; under nominal chance where the world has actions that no outcome carries out.
    ///
    /// # Errors
    /// If the policy does not fit the world.
    fn occupancy(&self, policy: &TablePolicy) -> Result<Vec<f64>, ExactError>;

    /// What the policies that are optimal at some budgets attain: CVaR_alpha and mean, one point for
    /// each budget.
    ///
    /// # Errors
    /// If a budget or alpha is out of range.
    fn frontier(&self, etas: &[f64], alpha: f64) -> Result<Vec<[f64; 2]>, ExactError>;
}

/// The exact laws of the return of one policy under nominal chance.
#[derive(Debug, Clone, PartialEq)]
pub struct Laws {
    /// Of the policy that takes the likeliest action.
    pub greedy: ReturnLaw,
    /// Of the policy that draws its action.
    pub sampled: ReturnLaw,
}

/// An antagonist that reweights chance only by time and state.
pub trait Ratios: Send + Sync {
    /// The likelihood ratios delta_t(o), shape `[outcomes]`, after `action` at a time in a state of a
    /// running episode. Their mean under the nominal law is 1 for the action that the greedy policy
    /// takes there.
    fn ratios(&self, time: u32, state: usize, action: usize) -> Vec<f64>;
}

/// A finite world, with the optima that were asked for.
struct Exact<W> {
    world: ExactWorld<W>,
    /// By budget.
    solved: Mutex<Vec<(f64, Arc<Optimum>)>>,
    /// CVaR of the best stationary policy that was found, by budget.
    stationary: Mutex<Vec<(f64, f64)>>,
}

impl<W: World> Exact<W> {
    fn mdp(&self) -> &FiniteMdp {
        self.world.mdp()
    }

    fn optimum(&self, eta: f64) -> Result<Arc<Optimum>, ExactError> {
        let mut solved = self.solved.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some((_, optimum)) = solved.iter().find(|(of, _)| *of == eta) {
            return Ok(Arc::clone(optimum));
        }
        let optimum = Arc::new(self.world.optimum(eta)?);
        solved.push((eta, Arc::clone(&optimum)));
        Ok(optimum)
    }

    /// One episode of a deterministic policy.
    fn walk(&self, policy: &Policy, seed: u64, index: u64) -> Walk {
        let (model, mdp) = (self.world.model(), self.mdp());
        let mut chance = stream(seed, Purpose::EvaluationOutcomes, index);
        let place = |state: usize| model.coordinates(state).map(|place| place as f64);
        let mut node = mdp.start_node();
        let mut walk = Walk {
            index,
            end: End::Timeout,
            value: 0.0,
            path: vec![place(node.state)],
            actions: Vec::new(),
            outcomes: Vec::new(),
        };
        loop {
            let action = policy.action(mdp, node);
            let outcome = sample_index(&model.probabilities(node.state, action), &mut chance);
            walk.actions.push(model.arrow(action));
            let arrow = W::Law::outcome(outcome).map(W::outcome_arrow);
            walk.outcomes.push(arrow.expect("outcomes of a finite world have indices"));
            walk.path.push(place(mdp.outcome(node.state, action, outcome).next));
            if let Some((end, value)) = mdp.ending(node, action, outcome) {
                return Walk { end, value, ..walk };
            }
            node = mdp.successor(node, action, outcome).expect("the episode has not ended");
        }
    }

    /// CVaR_{1/eta} of the best stationary policy found.
    fn stationary(&self, eta: f64) -> Result<f64, ExactError> {
        let optimum = self.optimum(eta)?;
        let mut found = self.stationary.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some((_, cvar)) = found.iter().find(|(of, _)| *of == eta) {
            return Ok(*cvar);
        }
        let cvar = stationary::search(self.mdp(), require_eta(eta)?, &optimum.policy)?.cvar;
        found.push((eta, cvar));
        Ok(cvar)
    }
}

impl<W: World> Yardstick for Exact<W> {
    fn answer(&self, eta: f64, _: &dyn Watch) -> Result<Option<Box<dyn Answer>>, YardstickError> {
        Ok(Some(Box::new(self.world.solve(eta)?)))
    }

    fn optimal_law(&self, eta: f64) -> Result<Option<ReturnLaw>, YardstickError> {
        Ok(Some(self.optimum(eta)?.evaluation.law.clone()))
    }

    fn walks(&self, eta: f64, seed: u64, count: u64) -> Result<Vec<Walk>, YardstickError> {
        let optimum = self.optimum(eta)?;
        Ok((0..count).map(|index| self.walk(&optimum.policy, seed, index)).collect())
    }

    fn compare(
        &self,
        eta: f64,
        evidence: &Evidence<'_>,
    ) -> Result<Option<Comparison>, YardstickError> {
        let optimum = self.optimum(eta)?;
        let Some(policy) = evidence.policy else {
            return Ok(Comparison::of_episodes(eta, (optimum.cvar, 0.0), evidence));
        };
        let sampled = policy.on(&self.world)?;
        let found = self.world.certificate(&optimum, &sampled, eta)?;
        let class = if policy.sees_time() { None } else { Some(self.stationary(eta)?) };
        let neutral = Response { value: optimum.cvar, error: 0.0 };
        let response = evidence.response.or((eta == 1.0).then_some(neutral));
        let (antagonist_gap, antagonist_gap_standard_error) =
            evidence.opposed.map_or((0.0, 0.0), |law| {
                (found.antagonist_gap(law.mean()), law.mean_standard_error())
            });
        Ok(Some(Comparison {
            optimum: found.optimal_cvar,
            regret: found.regret,
            regret_standard_error: 0.0,
            antagonist_gap,
            antagonist_gap_standard_error,
            class_regret: class.map(|best| best - found.greedy.cvar),
            exploitability: response
                .map(|response| Exploitability::new(found.optimal_cvar, found.regret, response)),
        }))
    }

    fn exact(&self) -> Option<&dyn ExactYardstick> {
        Some(self)
    }
}

impl<W: World> ExactYardstick for Exact<W> {
    fn laws(&self, policy: &TablePolicy) -> Result<Laws, ExactError> {
        let sampled = policy.on(&self.world)?;
        let greedy = sampled.greedy(self.mdp());
        Ok(Laws {
            greedy: evaluate(self.mdp(), &greedy).law,
            sampled: evaluate(self.mdp(), &sampled).law,
        })
    }

    fn regret(&self, eta: f64, policy: &TablePolicy) -> Result<f64, ExactError> {
        let alpha = require_eta(eta)?;
        let greedy = policy.on(&self.world)?.greedy(self.mdp());
        Ok(self.optimum(eta)?.cvar - evaluate(self.mdp(), &greedy).law.cvar(alpha))
    }

    fn best_response(
        &self,
        eta: f64,
        antagonist: &mut dyn Frozen,
    ) -> Result<Option<Response>, ExactError> {
        response::best_response(self.mdp(), eta, antagonist)
    }

    fn worst_case(
        &self,
        eta: f64,
        policy: &TablePolicy,
    ) -> Result<Box<dyn Ratios + '_>, ExactError> {
        if !self.mdp().one_level() {
            return Err(ExactError::Levels(W::NAME));
        }
        let greedy = policy.on(&self.world)?.greedy(self.mdp());
        let worst = self.world.worst_case(&greedy, eta)?;
        Ok(Box::new(ExactRatios { world: &self.world, worst }))
    }

    fn exposure(&self, eta: f64, policy: &TablePolicy) -> Result<Exposure, ExactError> {
        let greedy = policy.on(&self.world)?.greedy(self.mdp());
        let worst = self.world.worst_case(&greedy, eta)?;
        Ok(self.world.exposure(&greedy, &worst))
    }

    fn changes(&self, eta: f64, policy: &TablePolicy) -> Result<Changes, ExactError> {
        changes(&self.world, eta, self.optimum(eta)?.cvar, policy)
    }

    fn occupancy(&self, policy: &TablePolicy) -> Result<Vec<f64>, ExactError> {
        let greedy = policy.on(&self.world)?.greedy(self.mdp());
        self.world.occupancy(&greedy)
    }

    fn frontier(&self, etas: &[f64], alpha: f64) -> Result<Vec<[f64; 2]>, ExactError> {
        super::require_alpha(alpha)?;
        let point = |&eta| {
            let optimum = self.optimum(eta)?;
            let law = &optimum.evaluation.law;
            Ok([law.cvar(alpha), law.mean()])
        };
        etas.iter().map(point).collect()
    }
}

struct ExactRatios<'a, W> {
    world: &'a ExactWorld<W>,
    worst: WorstCase<'a>,
}

impl<W: World> Ratios for ExactRatios<'_, W> {
    fn ratios(&self, time: u32, state: usize, action: usize) -> Vec<f64> {
        let node = self.world.node(time, state);
        let outcomes = self.world.mdp().outcome_count(state, action);
        (0..outcomes).map(|outcome| self.worst.delta(node, action, outcome)).collect()
    }
}

/// The certified controller of `lava-point`.
struct Oracle {
    constants: PointConfig,
    gamma: f64,
    effort: Effort,
    source: Source,
    upper_cell: Option<f64>,
}

impl Oracle {
    /// The upper bound; `None` where there is none, or none comes with the program and nothing may be computed.
    fn bound(&self, watch: &dyn Watch) -> Result<Option<UpperBound>, OracleError> {
        if self.gamma != 1.0 {
            return Ok(None);
        }
        match self.source {
            Source::Shipped => Ok(oracle::shipped_bound(&self.constants)),
            Source::Computed | Source::Anew => {
                let folder = oracle::cache_folder();
                oracle::bound_cached(&self.constants, self.upper_cell, folder.as_deref(), watch)
            }
        }
    }

    fn certified(&self, eta: f64, watch: &dyn Watch) -> Result<Option<Certified>, OracleError> {
        let Oracle { constants, gamma, effort, source, .. } = self;
        let gamma = *gamma;
        Ok(match (source, oracle::cache_folder()) {
            (Source::Shipped, _) => oracle::shipped(constants, gamma, eta, effort),
            (_, None) => Some(oracle::certify(constants, gamma, eta, effort, watch)?),
            (Source::Computed, Some(folder)) => {
                Some(oracle::certify_cached(constants, gamma, eta, effort, &folder, watch)?)
            }
            (Source::Anew, Some(folder)) => {
                Some(oracle::certify_anew(constants, gamma, eta, effort, &folder, watch)?)
            }
        })
    }
}

impl Yardstick for Oracle {
    fn answer(
        &self,
        eta: f64,
        watch: &dyn Watch,
    ) -> Result<Option<Box<dyn Answer>>, YardstickError> {
        let mut steps = Steps::new(watch, 2.0);
        let Some(certified) = self.certified(eta, &steps.next(1.0))? else { return Ok(None) };
        let bound = self.bound(&steps.next(1.0))?;
        Ok(Some(Box::new(Bracket::new(certified, bound.as_ref()))))
    }

    fn optimal_law(&self, eta: f64) -> Result<Option<ReturnLaw>, YardstickError> {
        Ok(self.certified(eta, &())?.map(|certified| certified.law))
    }

    fn walks(&self, eta: f64, seed: u64, count: u64) -> Result<Vec<Walk>, YardstickError> {
        let certified = self.certified(eta, &())?.filter(|_| seed == oracle::WALKS_SEED);
        let walks = certified.map_or(Vec::new(), |certified| certified.walks);
        Ok(walks.into_iter().take(count as usize).collect())
    }

    fn compare(
        &self,
        eta: f64,
        evidence: &Evidence<'_>,
    ) -> Result<Option<Comparison>, YardstickError> {
        let alpha = require_eta(eta)?;
        let Some(oracle) = self.certified(eta, &())? else { return Ok(None) };
        let error = oracle.law.cvar_standard_error(alpha);
        Ok(Comparison::of_episodes(eta, (oracle.certified_cvar, error), evidence))
    }
}
