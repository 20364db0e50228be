"""Names of countries as files write them, to ISO 3166-1 alpha-2."""

from __future__ import annotations

import re
from functools import cache

_LOCALE = re.compile(r"[a-z]{2}[-_]([A-Z]{2})")

# ISO 3166-1: alpha-2 followed by alpha-3
_CODES = """
    ADAND AEARE AFAFG AGATG AIAIA ALALB AMARM AOAGO AQATA ARARG ASASM ATAUT AUAUS AWABW AXALA AZAZE BABIH BBBRB
    BDBGD BEBEL BFBFA BGBGR BHBHR BIBDI BJBEN BLBLM BMBMU BNBRN BOBOL BQBES BRBRA BSBHS BTBTN BVBVT BWBWA BYBLR
    BZBLZ CACAN CCCCK CDCOD CFCAF CGCOG CHCHE CICIV CKCOK CLCHL CMCMR CNCHN COCOL CRCRI CUCUB CVCPV CWCUW CXCXR
    CYCYP CZCZE DEDEU DJDJI DKDNK DMDMA DODOM DZDZA ECECU EEEST EGEGY EHESH ERERI ESESP ETETH FIFIN FJFJI FKFLK
    FMFSM FOFRO FRFRA GAGAB GBGBR GDGRD GEGEO GFGUF GGGGY GHGHA GIGIB GLGRL GMGMB GNGIN GPGLP GQGNQ GRGRC GSSGS
    GTGTM GUGUM GWGNB GYGUY HKHKG HMHMD HNHND HRHRV HTHTI HUHUN IDIDN IEIRL ILISR IMIMN ININD IOIOT IQIRQ IRIRN
    ISISL ITITA JEJEY JMJAM JOJOR JPJPN KEKEN KGKGZ KHKHM KIKIR KMCOM KNKNA KPPRK KRKOR KWKWT KYCYM KZKAZ LALAO
    LBLBN LCLCA LILIE LKLKA LRLBR LSLSO LTLTU LULUX LVLVA LYLBY MAMAR MCMCO MDMDA MEMNE MFMAF MGMDG MHMHL MKMKD
    MLMLI MMMMR MNMNG MOMAC MPMNP MQMTQ MRMRT MSMSR MTMLT MUMUS MVMDV MWMWI MXMEX MYMYS MZMOZ NANAM NCNCL NENER
    NFNFK NGNGA NINIC NLNLD NONOR NPNPL NRNRU NUNIU NZNZL OMOMN PAPAN PEPER PFPYF PGPNG PHPHL PKPAK PLPOL PMSPM
    PNPCN PRPRI PSPSE PTPRT PWPLW PYPRY QAQAT REREU ROROU RSSRB RURUS RWRWA SASAU SBSLB SCSYC SDSDN SESWE SGSGP
    SHSHN SISVN SJSJM SKSVK SLSLE SMSMR SNSEN SOSOM SRSUR SSSSD STSTP SVSLV SXSXM SYSYR SZSWZ TCTCA TDTCD TFATF
    TGTGO THTHA TJTJK TKTKL TLTLS TMTKM TNTUN TOTON TRTUR TTTTO TVTUV TWTWN TZTZA UAUKR UGUGA UMUMI USUSA UYURY
    UZUZB VAVAT VCVCT VEVEN VGVGB VIVIR VNVNM VUVUT WFWLF WSWSM YEYEM YTMYT ZAZAF ZMZMB ZWZWE
"""
# Names in English, and in the language of the country where exporters write it so
_NAMES = {
    "AE": "united arab emirates",
    "AT": "austria,österreich,oesterreich",
    "AU": "australia",
    "BE": "belgium,belgië,belgique",
    "BG": "bulgaria",
    "BR": "brazil,brasil",
    "CA": "canada",
    "CH": "switzerland,schweiz,suisse,svizzera",
    "CN": "china,people's republic of china,prc",
    "CY": "cyprus",
    "CZ": "czechia,czech republic,česko",
    "DE": "germany,deutschland,ger",
    "DK": "denmark,danmark",
    "EE": "estonia,eesti",
    "ES": "spain,españa",
    "FI": "finland,suomi",
    "FR": "france",
    "GB": "united kingdom,great britain,uk,england,scotland,wales",
    "GR": "greece",
    "HR": "croatia,hrvatska",
    "HU": "hungary,magyarország",
    "IE": "ireland",
    "IL": "israel",
    "IN": "india",
    "IS": "iceland",
    "IT": "italy,italia",
    "JP": "japan",
    "KR": "south korea,korea,republic of korea",
    "LI": "liechtenstein",
    "LT": "lithuania,lietuva",
    "LU": "luxembourg,luxemburg",
    "LV": "latvia,latvija",
    "MC": "monaco",
    "MT": "malta",
    "MX": "mexico,méxico",
    "MY": "malaysia",
    "NL": "netherlands,the netherlands,nederland,holland",
    "NO": "norway,norge",
    "NZ": "new zealand",
    "PL": "poland,polska",
    "PT": "portugal",
    "RO": "romania,românia",
    "RS": "serbia",
    "RU": "russia,russian federation",
    "SA": "saudi arabia",
    "SE": "sweden,sverige",
    "SG": "singapore",
    "SI": "slovenia,slovenija",
    "SK": "slovakia,slovensko",
    "TH": "thailand",
    "TR": "turkey,türkiye",
    "TW": "taiwan",
    "UA": "ukraine",
    "US": "united states,united states of america,u.s.a.",
    "VN": "vietnam,viet nam",
    "ZA": "south africa",
}


def country_code(text: str) -> str | None:
    """Return the ISO 3166-1 alpha-2 code of a country given by alpha-2, alpha-3 or name in any case; None otherwise.

    Of a language and its country, as in `de-DE`, that is the country.
    """
    name = text.strip()
    locale = _LOCALE.fullmatch(name)
    return _known().get((locale[1] if locale else name).casefold())


@cache
def _known() -> dict[str, str]:
    codes = _CODES.split()
    named = {name.casefold(): code for code, names in _NAMES.items() for name in names.split(",")}
    return named | {c[2:].casefold(): c[:2] for c in codes} | {c[:2].casefold(): c[:2] for c in codes}
