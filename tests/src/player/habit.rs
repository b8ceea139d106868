//! What may be wrong with it, each by itself legal on the wire.

macro_rules! habits {
    ($($(#[$doc:meta])* $habit:ident $name:literal;)*) => {
        /// One thing that is wrong with it.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Habit {
            $($(#[$doc])* $habit,)*
        }

        impl Habit {
            /// All of them.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$habit),*];
            /// Its name in counts.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$habit => $name),* }
            }
        }
    };
}

habits! {
    /// It beats and answers no offer.
    NeverAnswers "never answers";
    /// It answers when the offer is over.
    AnswersLate "answers late";
    /// It refuses, for any reason there is.
    Refuses "refuses";
    /// It takes offers and lets them go at once, unasked.
    LetsGo "accepts and lets go";
    /// It takes offers and says at once that they cannot be done as asked.
    CallsImpossible "fails as semantic";
    /// It takes offers and says at once that every step is done, and goes nowhere.
    NeverGoes "succeeds from afar";
    /// It says what it has said again, under new numbers.
    RepeatsItself "repeats itself";
    /// It says of its attempt what contradicts what it has said.
    Contradicts "contradicts itself";
    /// Lists are as long as they may be, and longer than anything makes sense.
    EndlessLists "endless lists";
    /// Steps that the task does not have, and success before the first.
    WrongSteps "impossible steps";
    /// It is in places that it cannot be in, on grants that nobody gave.
    WrongPlaces "impossible places";
    /// It carries what others carry, or nothing any more.
    WrongLoads "impossible loads";
    /// It has attempts of others, and such as nobody gave.
    ForeignAttempts "foreign attempts";
    /// It says nothing for a while, most of all after it took something.
    FallsSilent "falls silent";
    /// A second machine has its name.
    StartsTwice "starts twice";
    /// It begins again and again, and forgets what it knew.
    Restarts "restarts";
    /// Its clocks are absurd.
    WrongClocks "wrong clocks";
    /// It has applied what nobody sent, or nothing.
    WrongGenerations "wrong generations";
    /// Modes, stops and faults come and go.
    Flickers "flickers";
    /// It is anywhere, with any charge.
    Wanders "wanders";
    /// It lists nothing of what it has.
    Forgets "forgets attempts";
    /// Numbers of its lanes are missing.
    LosesNumbers "loses numbers";
    /// It keeps its work and does nothing of it.
    NeverMovesOn "never moves on";
    /// It goes on with what it was told to end.
    NeverEnds "never ends";
    /// It says that its software changes.
    ClaimsUpdates "claims updates";
    /// Texts as long as a message takes.
    EndlessTexts "endless texts";
    /// STATUS without end, of absurd values.
    FloodsStatus "floods STATUS";
}
