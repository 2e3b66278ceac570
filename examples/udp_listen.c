/* Listen to `relnav node relay --to udp://HOST:PORT`:  cc -o udp_listen udp_listen.c && ./udp_listen 5600
 *
 * Without a port it reads one datagram from standard input. */
#include <arpa/inet.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "relnav_udp.h"

static int show(const relnav_state *state, long bytes)
{
    if (bytes != (long)sizeof *state || memcmp(state->magic, "RNAV", 4) || state->version != RELNAV_VERSION ||
        state->crc32 != relnav_crc32(state, sizeof *state - 8)) {
        fprintf(stderr, "no RNAV packet of version 1\n");
        return 1;
    }
    if (!(state->flags & RELNAV_VALID)) {
        printf("%lld mode %d: hold\n", (long long)state->sequence, state->mode);
        return 0;
    }
    printf("%lld mode %d: %.17g %.17g %.17g m, variance along x %.17g m2, age %.3f s\n",
           (long long)state->sequence, state->mode, state->position_m[0], state->position_m[1],
           state->position_m[2], state->covariance_upper[0], state->age_s);
    return 0;
}

int main(int argc, char **argv)
{
    relnav_state state;
    if (argc < 2)
        return show(&state, (long)read(0, &state, sizeof state));
    int listening = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(argv[1]))};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (bind(listening, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("bind");
        return 1;
    }
    for (;;) {
        long bytes = (long)recv(listening, &state, sizeof state, 0);
        show(&state, bytes);
        fflush(stdout);
    }
}
