//! The two PPO players of a game, and how they act.

use super::device::Device;
use super::family::{self, Antagonist, Reweighting};
use super::head::{HeadOf, PolicyHead};
use super::inputs::Inputs;
use super::method::{Arena, Players, Setting};
use super::observation::Observation;
use super::options::{Acts, Adversary, Role};
use super::policy::{
    Draw, DrawOpponent, DrawResponse, DrawSituation, Draws, Mode, Noise, Opponent, Policy,
    Response, Situation, Streams,
};
use super::ppo::Player;
use super::vector_game::Spending;
use super::weights::{self, Weights, WeightsError};
use crate::game::columns::{Column, SAMPLES};
use lava_envs::random::{ChaCha8Rng, Purpose, stream};
use lava_envs::{Action, Law, World};

/// The head of a world's protagonist.
pub type HeadIn<W> = <<<W as World>::Action as Action>::Kind as HeadOf<<W as World>::Action>>::Head;
/// The protagonist of a world.
pub type Protagonist<W> = Player<HeadIn<W>>;

/// Name of the antagonist's half on the protagonist's draw, in files and messages.
pub const ACTION_ANTAGONIST: &str = "action-antagonist";

/// The two players of a game.
#[derive(Debug)]
pub struct Pair<W: Arena> {
    /// Chooses the actions.
    pub protagonist: Protagonist<W>,
    /// Reweights chance; absent at eta = 1, where it could not change anything.
    pub antagonist: Option<Box<dyn Antagonist<W::Law>>>,
    /// Its half that reweights the protagonist's draw; absent but in the game `joint`.
    pub action_antagonist: Option<Box<dyn Antagonist<Noise<W>>>>,
    /// What they see.
    pub observation: Observation,
    /// Whether the antagonist follows its network, or plays at random.
    pub adversary: Adversary,
    /// What the antagonist's budget is for. One of single steps is not the game's, and such an antagonist is no
    /// opponent in evaluation.
    pub spending: Spending,
    device: Device,
}

impl<W: Arena> Pair<W> {
    /// Two fresh players for games in this world.
    pub fn new(world: &W, setting: &Setting<'_>) -> Self {
        let Setting { eta, seed, device, options, .. } = *setting;
        let observation = Observation::new(world, options, eta);
        let protagonist = Player::new(
            <W::Action as Action>::Kind::head(options),
            observation.protagonist_columns::<W>(),
            options.protagonist.hidden,
            device,
            &mut stream(seed, Purpose::ProtagonistWeights, 0),
        );
        let antagonist = (!eta.is_neutral()).then(|| {
            family::antagonist(
                &options.family,
                observation.antagonist_columns::<W>(),
                options.antagonist.hidden,
                device,
                &mut stream(seed, Purpose::AntagonistWeights, 0),
            )
        });
        let joint = !eta.is_neutral() && options.antagonist_acts == Acts::Joint;
        let action_antagonist = joint.then(|| {
            family::antagonist(
                &family::fitting::<Noise<W>>(&options.family),
                observation.draw_columns::<W>(),
                options.antagonist.hidden,
                device,
                &mut stream(seed, Purpose::ActionAntagonistWeights, 0),
            )
        });
        let adversary = options.adversary;
        let spending = Spending::default();
        Pair {
            protagonist,
            antagonist,
            action_antagonist,
            observation,
            adversary,
            spending,
            device,
        }
    }

    /// The same, with budgets for this.
    #[must_use]
    pub fn spending(self, spending: Spending) -> Self {
        Pair { spending, ..self }
    }

    /// Parameters of a player's networks; empty for an absent one.
    pub fn parameters(&self, role: Role) -> &[f32] {
        match role {
            Role::Protagonist => self.protagonist.network.parameters(),
            Role::Antagonist => self.antagonist.as_ref().map_or(&[], |a| a.network().parameters()),
        }
    }

    /// The antagonist at play, if there is one; `audit` requests the normalisation error, which training does not
    /// need.
    pub fn opponent(&self, audit: bool) -> Option<LearnedOpponent<'_, W>> {
        let antagonist = self.antagonist.as_deref()?;
        let normalisation_error = audit.then_some(0.0);
        Some(LearnedOpponent {
            antagonist,
            pair: self,
            inputs: Inputs::default(),
            outputs: Vec::new(),
            draw_inputs: Inputs::default(),
            normalisation_error,
        })
    }
}

impl<W: Arena> Players<W> for Pair<W> {
    fn protagonist(&self) -> Box<dyn Policy<W> + '_> {
        Box::new(PpoPolicy::new(&self.protagonist, self.observation))
    }

    fn opponent(&self) -> Option<Box<dyn Opponent<W> + '_>> {
        if self.spending == Spending::Step {
            return None;
        }
        Some(Box::new(Pair::opponent(self, true)?))
    }

    fn observation(&self) -> Option<Observation> {
        Some(self.observation)
    }

    fn act(&self, inputs: &Inputs, mode: Mode, random: &mut ChaCha8Rng) -> Option<Vec<W::Action>> {
        let Player { head, network, .. } = &self.protagonist;
        let (mut outputs, mut parameters) = (Vec::new(), Vec::new());
        network.act(inputs.rows(), &mut outputs);
        let samples = inputs.numbers.len() / network.shape().width();
        let choose = |sample| {
            self.protagonist.parameters_in(&outputs, sample, &mut parameters);
            head.choose(&parameters, mode, random)
        };
        Some((0..samples).map(choose).collect())
    }

    fn weights(&self, about: String) -> Result<Vec<u8>, WeightsError> {
        let mut networks = vec![(Role::Protagonist.name(), &self.protagonist.network)];
        networks.extend(self.antagonist.iter().map(|of| (Role::Antagonist.name(), of.network())));
        networks.extend(self.action_antagonist.iter().map(|of| (ACTION_ANTAGONIST, of.network())));
        weights::to_bytes(&networks, about)
    }

    fn load(&mut self, bytes: &[u8]) -> Result<(), WeightsError> {
        let file = Weights::read(bytes)?;
        let shape = self.protagonist.network.shape();
        self.protagonist.network = file.network(Role::Protagonist.name(), shape, self.device)?;
        if let Some(antagonist) = &mut self.antagonist {
            let shape = antagonist.network().shape();
            *antagonist.network_mut() =
                file.network(Role::Antagonist.name(), shape, self.device)?;
        }
        if let Some(antagonist) = &mut self.action_antagonist {
            let shape = antagonist.network().shape();
            *antagonist.network_mut() = file.network(ACTION_ANTAGONIST, shape, self.device)?;
        }
        Ok(())
    }
}

/// A PPO player's policy at play.
#[derive(Debug)]
pub struct PpoPolicy<'a, H: PolicyHead> {
    player: &'a Player<H>,
    observation: Observation,
    /// What it saw in its last step, a sample for each slot.
    pub inputs: Inputs,
    /// The outputs of its actor for it, shape `[k, slots]`.
    pub outputs: Vec<f32>,
    parameters: Vec<f64>,
    columns: Vec<Column>,
}

impl<'a, H: PolicyHead> PpoPolicy<'a, H> {
    /// The policy of a player.
    pub fn new(player: &'a Player<H>, observation: Observation) -> Self {
        let (inputs, outputs, parameters, columns) = Default::default();
        PpoPolicy { player, observation, inputs, outputs, parameters, columns }
    }

    /// Lets the actor see the world.
    fn look<W: World>(&mut self, world: &W) {
        self.observation.protagonist(world, &mut self.inputs);
        self.player.network.act(self.inputs.rows(), &mut self.outputs);
    }

    /// Appends the log-probabilities of choices in the slots of the last step.
    pub fn log_probabilities(&self, choices: &[H::Choice], log_probabilities: &mut Vec<f64>) {
        let given = vec![(); choices.len()];
        self.player.log_probabilities(&self.outputs, &given, choices, log_probabilities);
    }
}

impl<W, H> Draws<W> for PpoPolicy<'_, H>
where
    W: World,
    H: PolicyHead<Choice = W::Action, Noise = Noise<W>>,
{
    fn laws(&mut self, world: &W, laws: &mut Vec<Noise<W>>) {
        self.look(world);
        let PpoPolicy { player, outputs, parameters, .. } = self;
        laws.extend((0..world.episodes()).map(|slot| {
            player.parameters_in(outputs, slot, parameters);
            player.head.noise(parameters)
        }));
    }

    fn realise(&mut self, noise: &[<Noise<W> as Law>::Outcome], actions: &mut Vec<W::Action>) {
        let PpoPolicy { player, outputs, parameters, .. } = self;
        actions.extend(noise.iter().enumerate().map(|(slot, &noise)| {
            player.parameters_in(outputs, slot, parameters);
            player.head.realise(parameters, noise)
        }));
    }
}

impl<W, H> Policy<W> for PpoPolicy<'_, H>
where
    W: World,
    H: PolicyHead<Choice = W::Action, Noise = Noise<W>>,
{
    fn choose(
        &mut self,
        world: &W,
        mode: Mode,
        streams: &mut [Streams],
        actions: &mut Vec<W::Action>,
    ) {
        self.look(world);
        let PpoPolicy { player, outputs, columns, .. } = self;
        let slots = streams.len();
        for (start, streams) in (0..slots).step_by(SAMPLES).zip(streams.chunks_mut(SAMPLES)) {
            player.columns_in(outputs, start..start + streams.len(), columns);
            let random = streams.iter_mut().map(|of| &mut of.actions);
            player.head.choose_block(columns, mode, random, actions);
        }
    }

    fn probabilities(&mut self, world: &W) -> Option<Vec<f64>> {
        self.look(world);
        let mut probabilities = Vec::new();
        for slot in 0..world.episodes() {
            self.player.parameters_in(&self.outputs, slot, &mut self.parameters);
            if !self.player.head.probabilities(&self.parameters, &mut probabilities) {
                return None;
            }
        }
        Some(probabilities)
    }

    fn sees_time(&self) -> bool {
        self.observation.protagonist_sees_time()
    }

    fn draws(&mut self) -> Option<&mut dyn Draws<W>> {
        Some(self)
    }
}

/// A pair's antagonist at play.
#[derive(Debug)]
pub struct LearnedOpponent<'a, W: Arena> {
    antagonist: &'a dyn Antagonist<W::Law>,
    pair: &'a Pair<W>,
    /// What it saw in its last step, a sample for each slot.
    pub inputs: Inputs,
    outputs: Vec<f32>,
    /// What its half on the protagonist's draw saw in its last step.
    pub draw_inputs: Inputs,
    normalisation_error: Option<f64>,
}

impl<W: Arena> LearnedOpponent<'_, W> {
    /// Lets the antagonist see the situation.
    pub fn look(&mut self, situation: &Situation<'_, W>) {
        self.pair.observation.antagonist(situation, &mut self.inputs);
    }
}

impl<W: Arena> Opponent<W> for LearnedOpponent<'_, W> {
    fn respond(
        &mut self,
        situation: &Situation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: Response<'_, W>,
    ) {
        self.look(situation);
        let outputs = match self.pair.adversary {
            Adversary::Learned => {
                self.antagonist.network().act(self.inputs.rows(), &mut self.outputs);
                Some(&self.outputs[..])
            }
            Adversary::Random => None,
        };
        self.antagonist.reweight(Reweighting {
            outputs,
            laws: situation.laws,
            budgets: situation.budgets,
            draw,
            streams,
            stream: |of| &mut of.outcomes,
            outcomes: response.outcomes,
            ratios: response.ratios,
            normalisation_error: self.normalisation_error.as_mut(),
        });
    }

    fn all_ratios(&mut self, situation: &Situation<'_, W>) -> Option<Vec<f64>> {
        // One that also reweights draws has more to it than these ratios.
        if self.pair.adversary == Adversary::Random || self.pair.action_antagonist.is_some() {
            return None;
        }
        self.look(situation);
        self.antagonist.network().act(self.inputs.rows(), &mut self.outputs);
        self.antagonist.all_ratios(&self.outputs, situation.laws, situation.budgets)
    }

    fn sees_time(&self) -> bool {
        self.pair.observation.antagonist_sees_time()
    }

    fn of_draws(&mut self) -> Option<&mut dyn DrawOpponent<W>> {
        let plays = self.pair.action_antagonist.is_some();
        plays.then_some(self)
    }

    fn normalisation_error(&self) -> f64 {
        self.normalisation_error.unwrap_or(0.0)
    }
}

impl<W: Arena> DrawOpponent<W> for LearnedOpponent<'_, W> {
    fn respond_to_draw(
        &mut self,
        situation: &DrawSituation<'_, W>,
        draw: Draw,
        streams: &mut [Streams],
        response: DrawResponse<'_, W>,
    ) {
        let antagonist = self.pair.action_antagonist.as_deref().expect("it plays");
        self.pair.observation.draw(situation, &mut self.draw_inputs);
        antagonist.network().act(self.draw_inputs.rows(), &mut self.outputs);
        antagonist.reweight(Reweighting {
            outputs: Some(&self.outputs),
            laws: situation.laws,
            budgets: situation.budgets,
            draw,
            streams,
            stream: |of| &mut of.actions,
            outcomes: response.noise,
            ratios: response.ratios,
            normalisation_error: self.normalisation_error.as_mut(),
        });
    }
}
