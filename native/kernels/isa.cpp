// The kernels for one instruction set: CMakeLists.txt compiles this file once per ISA, with
// -DECONGS_ISA=<name> -DECONGS_LANES=<floats per vector> and that ISA's flags.
#include "adam.h"
#include "blend.h"
#include "composite.h"
#include "decoder_block.h"
#include "factors.h"
#include "project.h"
#include "sh.h"
#include "ssim.h"
#include "voxels.h"

#define STRING_OF(x) #x
#define STRING(x) STRING_OF(x)

namespace ECONGS_ISA {

extern const econgs::Kernels kernels;
const econgs::Kernels kernels = {STRING(ECONGS_ISA),
                                 LANES,
                                 project,
                                 project_backward,
                                 blend_scratch,
                                 blend,
                                 blend_backward,
                                 sh,
                                 sh_backward,
                                 ssim_scratch,
                                 ssim_rows,
                                 ssim_map,
                                 ssim_gradient,
                                 absolute,
                                 composite,
                                 alpha_sums,
                                 alpha_gradient,
                                 decode_scratch,
                                 decode_opacity,
                                 decode_block,
                                 decode_backward,
                                 shade_rows,
                                 adam,
                                 reference,
                                 line_products,
                                 line_products_backward,
                                 march_ray,
                                 scatter_voxels,
                                 voxel_variation,
                                 voxel_step};

}  // namespace ECONGS_ISA
