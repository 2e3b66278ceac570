"""The frozen families: three sizes of code, found once by ``search_instance`` and never to change.

| family | identities | distance | regions that may be missing |
|---|---|---|---|
| astratag48h16 | 1 008 | 16 | 6 |
| astratag48h12 | 64 512 | 12 | 5 |
| astratag48h9 | 4 193 280 | 9 | 4 |
"""

from astratag.codes.family import Family

FAMILIES = {
    family.name: family
    for family in (
        Family(
            name="astratag48h16",
            k=2,
            distance=16,
            step=51,
            corner_point=1,
            edge_point=62,
            corner_basis=(19, 39, 58, 16, 40, 7),
            edge_basis=(11, 31, 4, 41, 37, 25),
            seed=1,
        ),
        Family(
            name="astratag48h12",
            k=3,
            distance=12,
            step=61,
            corner_point=32,
            edge_point=31,
            corner_basis=(44, 58, 36, 62, 6, 43),
            edge_basis=(9, 6, 59, 26, 34, 11),
            seed=2,
        ),
        Family(
            name="astratag48h9",
            k=4,
            distance=9,
            step=8,
            corner_point=32,
            edge_point=56,
            corner_basis=(31, 61, 57, 29, 30, 42),
            edge_basis=(58, 49, 44, 15, 26, 59),
            seed=0,
        ),
    )
}
"""The families by name: ``astratag48h`` and the distance, 48 being the cells."""
