//! Who decides chance in Python's games: chance itself, the exact worst case of a policy, a trained antagonist, or
//! Python.

use crate::values::Playable;
use cvar_game::exact::table::TablePolicy;
use cvar_game::exact::yardstick::{self, Solvable, YardstickError};
use cvar_game::game::budget::{Budget, Eta};
use cvar_game::learn::device::Device;
use cvar_game::learn::family::{self, Antagonist, Reweighting};
use cvar_game::learn::head::HeadOf;
use cvar_game::learn::inputs::Columns;
use cvar_game::learn::method::Players;
use cvar_game::learn::options::FamilyOptions;
use cvar_game::learn::policy::{Draw, Nominal, Opponent, Response, Situation, Streams};
use lava_envs::law::sample_index;
use lava_envs::random::{Purpose, stream};
use lava_envs::{Action, Law};

/// Who decides chance.
pub enum Adversary<W: Playable> {
    /// Chance itself.
    Nominal,
    /// The exact worst case of a policy.
    WorstCase(WorstCase),
    /// That of a trained pair.
    Trained(Box<dyn Players<W>>),
    /// Python, by the parameters of the perturbations.
    Played(Box<dyn Antagonist<W::Law>>),
}

impl<W: Playable> Adversary<W> {
    /// Python's, with this family of perturbations.
    ///
    /// # Errors
    /// If the family does not fit the world.
    pub fn played(options: &FamilyOptions) -> Result<Self, String> {
        family::family_within_budget::<W::Law>(options)?;
        // Its networks are never asked.
        let columns = Columns { cells: 0, numbers: 1, critic_only: 0 };
        let random = &mut stream(0, Purpose::AntagonistWeights, 0);
        Ok(Adversary::Played(family::antagonist(options, columns, 1, Device::Cpu, random)))
    }

    /// Number of parameters of a perturbation that Python may choose; 0 where it does not.
    pub fn parameters(&self) -> usize {
        match self {
            Adversary::Played(antagonist) => antagonist.network().shape().outputs,
            _ => 0,
        }
    }

    /// Lets `play` meet the adversary; `parameters` of shape `[slots, k]` are Python's.
    ///
    /// # Errors
    /// If they are missing, of another shape or not finite.
    pub fn act(
        &mut self,
        parameters: Option<&[f32]>,
        slots: usize,
        play: impl FnOnce(&mut dyn Opponent<W>),
    ) -> Result<(), String> {
        match (self, parameters) {
            (Adversary::Played(antagonist), Some(parameters)) => {
                let count = antagonist.network().shape().outputs;
                if parameters.len() != slots * count {
                    return Err(format!(
                        "the antagonist's action must have shape ({slots}, {count})"
                    ));
                }
                if parameters.iter().any(|number| !number.is_finite()) {
                    return Err("the antagonist's action is not finite".to_owned());
                }
                // A row for each parameter.
                let outputs =
                    (0..count).flat_map(|k| parameters.iter().skip(k).step_by(count)).copied();
                let outputs: Vec<f32> = outputs.collect();
                play(&mut Acting { antagonist: &**antagonist, outputs: &outputs });
            }
            (Adversary::Played(_), None) => return Err("the antagonist has not acted".to_owned()),
            (_, Some(_)) => return Err("this antagonist takes no action".to_owned()),
            (Adversary::Nominal, None) => play(&mut Nominal),
            (Adversary::WorstCase(worst), None) => play(worst),
            (Adversary::Trained(players), None) => match players.opponent() {
                Some(mut opponent) => play(opponent.as_mut()),
                None => play(&mut Nominal), // at eta = 1
            },
        }
        Ok(())
    }
}

/// An antagonist whose perturbations have these parameters.
struct Acting<'a, L: Law> {
    antagonist: &'a dyn Antagonist<L>,
    outputs: &'a [f32],
}

impl<W: Playable> Opponent<W> for Acting<'_, W::Law> {
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    ) {
        self.antagonist.reweight(Reweighting {
            outputs: Some(self.outputs),
            laws: situation.laws,
            budgets: situation.budgets,
            draw,
            streams,
            stream: |of| &mut of.outcomes,
            outcomes: response.outcomes,
            ratios: response.ratios,
            normalisation_error: None,
        });
    }
}

/// The exact worst case of a greedy policy in a finite world. It leaves chance alone where the protagonist
/// takes another action than the policy, and never exceeds the remaining budget, so that it is admissible for
/// every protagonist; it is the worst case for that policy.
pub struct WorstCase {
    states: usize,
    outcomes: usize,
    /// The policy's action, by time and state.
    actions: Vec<usize>,
    /// Likelihood ratios of the outcomes after it, by time and state.
    ratios: Vec<f64>,
}

impl WorstCase {
    /// That of a policy in a world with these constants.
    ///
    /// # Errors
    /// If the world is not finite, or the policy does not fit it.
    pub fn new<W: Solvable>(
        constants: &W::Constants,
        gamma: f64,
        eta: Eta,
        policy: &TablePolicy,
    ) -> Result<Self, String> {
        let world = W::new(constants, 1).map_err(|error| error.to_string())?;
        let model = world.finite();
        let yardstick = W::yardstick(constants, gamma, &yardstick::Options::default());
        let yardstick = yardstick.map_err(|error: YardstickError| error.to_string())?;
        let exact = yardstick.as_ref().and_then(|yardstick| yardstick.exact());
        let (Some(model), Some(exact)) = (model, exact) else {
            return Err(format!(
                "the exact worst case is known in finite worlds only, not {}",
                W::NAME
            ));
        };
        let worst = exact.worst_case(eta.get(), policy).map_err(|error| error.to_string())?;
        let (states, outcomes) = (model.states(), model.outcomes());
        let (mut actions, mut ratios) = (Vec::new(), Vec::new());
        for time in 0..world.horizon() {
            for state in 0..states {
                let action = policy.greedy_action(time, state);
                actions.push(action);
                match model.ended(state) {
                    None => ratios.extend(worst.ratios(time, state, action)),
                    Some(_) => ratios.extend(std::iter::repeat_n(1.0, outcomes)),
                }
            }
        }
        Ok(WorstCase { states, outcomes, actions, ratios })
    }

    /// The likelihood ratios by time, state and outcome, after the policy's action.
    pub fn ratios(&self) -> &[f64] {
        &self.ratios
    }

    /// The likelihood ratios of the outcomes of a law after any action, within a budget.
    pub fn within(
        &self,
        time: u32,
        state: usize,
        action: usize,
        law: &[f64],
        budget: Budget,
    ) -> Vec<f64> {
        let place = time as usize * self.states + state;
        if self.actions.get(place) != Some(&action) {
            return vec![1.0; self.outcomes];
        }
        let ratios = &self.ratios[place * self.outcomes..][..self.outcomes];
        let possible = ratios.iter().zip(law).filter(|(_, nominal)| **nominal > 0.0);
        let supremum = possible.map(|(ratio, _)| *ratio).fold(1.0, f64::max);
        let mixing = budget.mix(supremum.ln());
        ratios.iter().map(|ratio| mixing.likelihood_ratio(*ratio)).collect()
    }
}

impl<W: Playable> Opponent<W> for WorstCase {
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    ) {
        let world = situation.world;
        let model = world.finite().expect("only finite worlds have an exact worst case");
        for (slot, streams) in streams.iter_mut().enumerate() {
            let (time, state) = (world.time(slot), model.state(slot));
            let action = <W::Action as Action>::Kind::index(situation.actions[slot]);
            let mut law = model.probabilities(state, action);
            let budget = situation.budgets[slot];
            let ratios = if model.is_over(slot) {
                vec![1.0; self.outcomes]
            } else {
                self.within(time, state, action, &law, budget)
            };
            if draw == Draw::Perturbed {
                law.iter_mut().zip(&ratios).for_each(|(nominal, ratio)| *nominal *= ratio);
            }
            let index = sample_index(&law, &mut streams.outcomes);
            response.outcomes.push(W::Law::outcome(index).expect("outcomes have indices"));
            response.ratios[slot] = ratios[index];
        }
    }
}
