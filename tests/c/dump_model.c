/* Writes arrays of an exported model as they lie in memory; compiles as C and as C++. */
#include <stdio.h>

#include "lsdt_clip.h"

static int save(FILE *file, const void *data, size_t size) { return fwrite(data, 1, size, file) == size; }

int main(int argc, char **argv) {
    FILE *file = argc == 2 ? fopen(argv[1], "wb") : NULL;
    int saved = file && save(file, lsdt_clip_digest, sizeof lsdt_clip_digest)
                && save(file, lsdt_clip_step_cm, sizeof lsdt_clip_step_cm)
                && save(file, lsdt_clip_basis, sizeof lsdt_clip_basis)
                && save(file, lsdt_clip_rig_bones, sizeof lsdt_clip_rig_bones)
                && save(file, lsdt_clip_rig_expected, sizeof lsdt_clip_rig_expected)
                && save(file, lsdt_clip_runs_240_scale, sizeof lsdt_clip_runs_240_scale)
                && save(file, lsdt_clip_runs_240_value, sizeof lsdt_clip_runs_240_value)
                && save(file, lsdt_clip_paper_60_value, sizeof lsdt_clip_paper_60_value);
    return !(saved && fclose(file) == 0);
}
