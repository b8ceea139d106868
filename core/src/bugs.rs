//! Naive rules that tests may switch on at run time, to prove that the right ones are needed: one list a crate, made by [`seeded_bugs!`](crate::seeded_bugs).
//!
//! Invariant: without the crate's feature `seeded-bugs` every question is answered `false` at compile time.

/// Makes `SeededBug`, the set `Bugs`, and one question for each bug.
#[macro_export]
macro_rules! seeded_bugs {
    ($($(#[$doc:meta])* $bug:ident $question:ident;)*) => {
        /// One naive rule.
        #[cfg(feature = "seeded-bugs")]
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum SeededBug {
            $($(#[$doc])* $bug,)*
        }

        /// Which naive rules are on. None by default.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct Bugs {
            #[cfg(feature = "seeded-bugs")]
            on: u64,
        }

        #[cfg(feature = "seeded-bugs")]
        impl Bugs {
            /// With these rules on.
            pub fn seeded(bugs: &[SeededBug]) -> Self {
                Self { on: bugs.iter().fold(0, |on, bug| on | 1 << *bug as u64) }
            }
            fn has(self, bug: SeededBug) -> bool {
                self.on & (1 << bug as u64) != 0
            }
        }

        impl Bugs {
            /// Whether this build has naive rules that could be switched on.
            pub const ARE_BUILT_IN: bool = cfg!(feature = "seeded-bugs");

            $($(#[$doc])*
            pub fn $question(self) -> bool {
                #[cfg(feature = "seeded-bugs")]
                {
                    self.has(SeededBug::$bug)
                }
                #[cfg(not(feature = "seeded-bugs"))]
                {
                    false
                }
            })*
        }
    };
}
