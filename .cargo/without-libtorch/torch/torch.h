// Found by the C++ compiler only where there is no libtorch: see CPLUS_INCLUDE_PATH in
// .cargo/config.toml. torch-sys is compiled before our own build script gets a chance to say
// anything, so this says it. An #include stops the compiler at once; after an #error it would go on
// and bury the message.
#include "NO LIBTORCH: run `cargo xtask setup`, or build without training: --no-default-features"
