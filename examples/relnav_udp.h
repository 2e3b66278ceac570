/* The datagram of `relnav node relay --to udp://HOST:PORT`, version 1: little-endian, 776 bytes, no padding.
 *
 * Fly on it only if RELNAV_VALID is set, the checksum holds and the state is young enough for you: t_capture_ns is the
 * time of validity.  Without RELNAV_NUMBERS all numbers from position_m on are NaN. */
#ifndef RELNAV_UDP_H
#define RELNAV_UDP_H

#include <stdint.h>

#define RELNAV_VERSION 1
#define RELNAV_VALID 1   /* TRACK: may be flown on */
#define RELNAV_NUMBERS 2 /* TRACK or COAST: numbers are given */

enum { RELNAV_INIT, RELNAV_AMBIGUOUS, RELNAV_TRACK, RELNAV_COAST, RELNAV_LOST };

typedef struct {
    char magic[4];                 /* "RNAV" */
    uint16_t version;              /* RELNAV_VERSION */
    uint8_t mode;
    uint8_t flags;
    int64_t sequence;              /* of the frame */
    int64_t t_capture_ns;          /* UTC, mid-exposure */
    double age_s;                  /* since the last accepted measurement; NaN when there was none */
    double hypothesis_probability;
    double position_m[3];          /* target's origin, chaser axes */
    double rotation_wxyz[4];       /* target's attitude in the chaser: takes target to chaser coordinates */
    double velocity_m_s[3];        /* of the target's origin, chaser axes, as the chaser sees it */
    double rate_rad_s[3];          /* of the target against the chaser, target axes */
    double covariance_upper[78];   /* 12x12, upper triangle row by row: position, rotation (right perturbation,
                                      target axes), velocity (chaser axes), rate (target axes) */
    uint32_t crc32;                /* IEEE, of the 768 bytes before */
    uint32_t zero;
} relnav_state;

_Static_assert(sizeof(relnav_state) == 776, "the datagram has 776 bytes");

/* Return the CRC-32 of n bytes, as zlib's. */
static inline uint32_t relnav_crc32(const void *data, unsigned n)
{
    const uint8_t *byte = (const uint8_t *)data;
    uint32_t crc = 0xFFFFFFFFu;
    while (n--) {
        crc ^= *byte++;
        for (int k = 0; k < 8; k++)
            crc = (crc >> 1) ^ (0xEDB88320u & -(crc & 1u));
    }
    return ~crc;
}

#endif
