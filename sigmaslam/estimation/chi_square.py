"""Quantiles of chi-square that gates and checks of covariances are made of."""

import numpy as np

# Share of a normal distribution within two standard deviations.
NORMAL_WITHIN_2 = 0.9544997361036416
# 68 % with 2 degrees of freedom.
CHI_SQUARE_68_OF_2 = 2.27886856637673
# 99 % with 2 degrees of freedom.
CHI_SQUARE_99_OF_2 = 9.21034037197618
# Medians with 0, 1, 2 and 3 degrees of freedom; of nothing no share is larger.
CHI_SQUARE_MEDIAN = np.array([np.inf, 0.454936423119572, 1.3862943611198906, 2.3659738843753377])
# 95 % with 0 to 6 degrees of freedom.
CHI_SQUARE_95 = np.array(
    [
        0.0,
        *(3.841458820694124, 5.991464547107979, 7.814727903251179),
        *(9.487729036781154, 11.070497693516351, 12.591587243743977),
    ]
)
# 2.5 and 97.5 % with 6 degrees of freedom.
CHI_SQUARE_BAND_OF_6 = np.array([1.2373442457912027, 14.44937533544792])
# 99.9 % with 0 to 6 degrees of freedom.
CHI_SQUARE_999 = np.array(
    [
        0.0,
        *(10.827566170662733, 13.815510557964274, 16.26623619623813),
        *(18.466826952903151, 20.515005652432876, 22.457744484825323),
    ]
)
# 99 % with 6 degrees of freedom.
CHI_SQUARE_99_OF_6 = 16.811893829770927
# 99.99 % with 6 degrees of freedom.
CHI_SQUARE_9999_OF_6 = 27.85634123601417
